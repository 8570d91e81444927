//! Options that other tests have no occasion for: each must change what it says it changes, and nothing else.

use std::path::{Path, PathBuf};

use cnerf_tests::{DATA, Folder, MODEL, number};
use image::{AnimationDecoder as _, GrayImage, codecs::gif::GifDecoder};
use serde_json::Value;

/// LPIPS weights, if this machine has them.
fn lpips() -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/weights/lpips_alexnet.safetensors");
    if !path.exists() {
        println!("skipped: {} is not on this machine", path.display());
        return None;
    }
    Some(path)
}

/// The items of a dataset's index.
fn items(folder: &Folder, dataset: &str) -> Vec<Value> {
    let index: Value = serde_json::from_slice(&folder.read(&format!("{dataset}/dataset.json"))).unwrap();
    index["items"].as_array().unwrap().clone()
}

fn labels(folder: &Folder, path: &str) -> GrayImage {
    image::load_from_memory(&folder.read(path)).unwrap().to_luma8()
}

/// A folder with portraits `a.cnerf` and `b.cnerf`.
fn folder_with_portraits(name: &str) -> Folder {
    let folder = Folder::with_model(name);
    for (index, name) in ["a", "b"].iter().enumerate() {
        std::fs::copy(folder.path(DATA).join(format!("images/0000{index}.png")), folder.path(&format!("{name}.png")))
            .unwrap();
        let few = "--aligned --pivot-steps 8 --tune-steps 1 --overwrite --out .";
        folder.run(&format!("invert {name}.png --model {MODEL} {few}")).done();
    }
    folder
}

#[test]
fn drawn_cameras_spread_as_told() {
    let folder = Folder::new("sigma");
    folder.run("synth --count 6 --size 32 --azimuth-sigma 0 --elevation-sigma 0.1 --out drawn").done();
    let items = items(&folder, "drawn");
    assert!(items.iter().all(|item| number(item, "azimuth") == 0.0));
    assert!(items.iter().any(|item| number(item, "elevation").abs() > 0.01));
}

#[test]
fn an_imported_set_has_its_cameras_and_classes() {
    let folder = Folder::with_model("import");
    let from = format!("dataset import --images {DATA}/images --masks {DATA}/masks --cameras {DATA}/dataset.json");
    folder.run(&format!("{from} --format cnerf-9 --jpeg 90 --out plain")).done();
    let (imported, original) = (items(&folder, "plain"), items(&folder, DATA));
    assert_eq!(imported.len(), original.len());
    for (item, original) in imported.iter().zip(&original) {
        let image = item["image"].as_str().unwrap();
        assert!(image.ends_with(".jpg"), "{item}");
        assert_eq!(folder.read(&format!("plain/{image}"))[..2], [0xff, 0xd8], "a JPEG's first bytes");
        assert_eq!(item["azimuth"], original["azimuth"]);
    }
    // Face and hair under each other's names.
    let names = "background,hair,eyes,eyebrows,mouth,nose,ears,face,neck";
    folder.run(&format!("{from} --format cnerf-9 --classes {names} --out swapped")).done();
    let mask = imported[0]["mask"].as_str().unwrap();
    let [plain, swapped] = ["plain", "swapped"].map(|set| labels(&folder, &format!("{set}/{mask}")));
    let swap = |label: u8| [0, 7, 2, 3, 4, 5, 6, 1, 8][usize::from(label)];
    assert!(plain.pixels().any(|pixel| pixel[0] == 7), "no hair");
    assert!(plain.pixels().zip(swapped.pixels()).all(|(plain, swapped)| swap(plain[0]) == swapped[0]));
}

#[test]
fn batch_and_kimg_decide_the_steps_of_a_run() {
    let folder = Folder::with_model("kimg");
    let run = format!("train --data {DATA} --out run --preset tiny --stage warmup --device cpu --dry-run");
    let told = folder.json(&format!("{run} --batch 3 --kimg 0.03"));
    let warmup = &told["config"]["warmup"];
    assert_eq!((number(warmup, "batch"), number(warmup, "steps")), (3.0, 10.0));
    assert_eq!(number(&told, "steps"), 10.0);
    let refused = folder.run(&format!("{run} --kimg 0"));
    assert_eq!((refused.code, refused.stderr.lines().count()), (2, 1), "{}", refused.stderr);
    if let Some(weights) = lpips() {
        let run = format!("train --data {DATA} --out run --preset tiny --stage upsampler --model {MODEL} --dry-run");
        let estimated = |run: &str| folder.json(run)["estimates"].as_array().map(Vec::len);
        let run = format!("{run} --set upsampler.pixels=0 --set upsampler.adversarial=1");
        assert_eq!(estimated(&run), Some(1));
        assert_eq!(estimated(&format!("{run} --lpips {}", weights.display())), Some(1));
    }
}

#[test]
fn generated_portraits_turn_and_show_single_regions() {
    let folder = Folder::with_model("turned");
    let pictures = ["", "--azimuth 0.4", "--elevation 0.3", "--regions hair,face"].map(|options| {
        let out = folder.path(&format!("out{}", options.len()));
        std::fs::create_dir(&out).unwrap();
        folder.run(&format!("generate --model {MODEL} --seeds 2 {options} --out {}", out.display())).done();
        folder.picture(&format!("out{}/seed0002.png", options.len()))
    });
    for (index, picture) in pictures.iter().enumerate() {
        assert!(!pictures[..index].contains(picture), "option {index} changes nothing");
    }
}

#[test]
fn a_camera_that_is_known_is_kept() {
    let folder = Folder::with_model("pose");
    std::fs::copy(folder.path(DATA).join("images/00002.png"), folder.path("drawn.png")).unwrap();
    let line = format!("invert drawn.png --aligned --model {MODEL} --pivot-steps 6 --tune-steps 1 --pose 0.2,-0.1");
    let portrait = |options: &str, out: &str| {
        folder.json(&format!("{line} {options} --device cpu --out {out}"))["portraits"][0].clone()
    };
    let kept = portrait("--fixed-camera", "kept");
    assert!((number(&kept, "azimuth") - 0.2).abs() < 1e-6 && (number(&kept, "elevation") + 0.1).abs() < 1e-6, "{kept}");
    let moved = portrait("", "moved");
    assert!(number(&moved, "azimuth") != number(&kept, "azimuth"), "{moved}");
}

#[test]
fn perceptual_weights_give_a_distance() {
    let Some(weights) = lpips() else { return };
    let folder = Folder::with_model("lpips");
    std::fs::copy(folder.path(DATA).join("images/00002.png"), folder.path("drawn.png")).unwrap();
    let few = format!("--pivot-steps 4 --tune-steps 1 --lpips {}", weights.display());
    let report = folder.json(&format!("invert drawn.png --aligned --model {MODEL} {few} --out out"));
    assert!(number(&report["portraits"][0], "lpips") > 0.0, "{report}");
    let known = "--known-pose --fixed-camera --variant ours";
    let report = folder.json(&format!("eval inversion --model {MODEL} --data {DATA} --count 1 {few} {known}"));
    let text = report.to_string();
    assert!(text.contains("\"lpips\":") && text.contains("\"pose_error_rad\":0.0"), "{text}");
}

#[test]
fn codes_of_another_portrait_and_of_the_mean_are_taken_once() {
    let folder = folder_with_portraits("from");
    for source in ["--from b.cnerf", "--mean"] {
        let change = |portrait: &str, out: &str| {
            let line = format!("edit {portrait} --model {MODEL} --region hair {source} --device cpu --out {out}");
            let report = folder.json(&line);
            number(&report, "inside_change")
        };
        let name = source.trim_start_matches("--").replace([' ', '.'], "_");
        assert!(change("a.cnerf", &format!("{name}.cnerf")) > 1e-3, "{source} changes nothing");
        // The codes are there already.
        assert!(change(&format!("{name}.cnerf"), &format!("{name}_again.cnerf")) < 1e-3, "{source} again changes more");
    }
}

/// The codes in a portrait file, a row of bytes for each region.
fn codes(folder: &Folder, name: &str) -> Vec<Vec<u8>> {
    let bytes = folder.read(name);
    let codes = safetensors::SafeTensors::deserialize(&bytes).unwrap().tensor("codes").unwrap().data().to_vec();
    codes.chunks_exact(codes.len() / 9).map(<[u8]>::to_vec).collect()
}

#[test]
fn amounts_mix_and_exaggerate() {
    let folder = folder_with_portraits("amount");
    let line = format!("edit a.cnerf --model {MODEL} --region hair --from b.cnerf");
    let change = |amount: &str| {
        let report = folder.json(&format!("{line} --amount {amount} --out at{amount}.cnerf"));
        number(&report, "inside_change")
    };
    assert_eq!(change("0"), 0.0);
    let [half, whole, beyond] = ["0.5", "1", "-1.5"].map(change);
    assert!(half > 0.0 && whole > half && beyond > 0.0, "{half} {whole} {beyond}");
    let numbers = |name: &str| -> Vec<f32> {
        codes(&folder, name)[7].chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect()
    };
    let (from, to) = (numbers("a.cnerf"), numbers("b.cnerf"));
    for (name, amount) in [("at0.5.cnerf", 0.5), ("at-1.5.cnerf", -1.5)] {
        for ((found, from), to) in numbers(name).iter().zip(&from).zip(&to) {
            assert!((found - (from + amount * (to - from))).abs() < 1e-4, "{name}: {found} {from} {to}");
        }
    }
    let refused = folder.run(&format!("{line} --amount 11 --out far.cnerf"));
    assert_eq!((refused.code, refused.stderr.lines().count()), (2, 1), "{}", refused.stderr);
    assert!(refused.stderr.contains("--amount"), "{}", refused.stderr);
}

#[test]
fn regions_take_their_own_sources_and_are_given_back_one_by_one() {
    let folder = folder_with_portraits("sources");
    let line = format!("edit a.cnerf --model {MODEL}");
    folder.json(&format!("{line} --region all --seed 5 --out c.cnerf"));
    let report = folder.json(&format!(
        "{line} --region hair --from b.cnerf --region mouth,nose --from c.cnerf --texture --out mixed.cnerf"
    ));
    assert!(number(&report, "inside_change") > 0.0 && number(&report, "depth_change") == 0.0, "{report}");
    let [a, b, c, mixed] = ["a", "b", "c", "mixed"].map(|name| codes(&folder, &format!("{name}.cnerf")));
    for region in 0..9 {
        let from = match region {
            7 => &b,
            4 | 5 => &c,
            _ => &a,
        };
        let (shape, texture) = mixed[region].split_at(a[region].len() / 2);
        assert_eq!(shape, &a[region][..shape.len()], "shape of region {region}");
        assert_eq!(texture, &from[region][shape.len()..], "texture of region {region}");
    }
    // Two edits, two steps back.
    folder.json(&format!("edit mixed.cnerf --model {MODEL} --undo --out once.cnerf"));
    let once = codes(&folder, "once.cnerf");
    assert!(once[7] == mixed[7] && once[4] == a[4] && once[5] == a[5]);
    folder.json(&format!("edit once.cnerf --model {MODEL} --undo --out twice.cnerf"));
    assert!(codes(&folder, "twice.cnerf") == a);
}

#[test]
fn edits_that_say_too_little_or_too_much_are_refused() {
    let folder = folder_with_portraits("unclear");
    for (options, said) in [
        ("--seed 1", "--region"),
        ("--region hair", "--from PORTRAIT"),
        ("--region hair --seed 1 --mean", "--seed"),
        ("--region hair --from b.cnerf --mean", "--mean"),
        ("--region hair --region eyes --region nose --from a.cnerf --from b.cnerf", "2 --from for 3 --region"),
        ("--region hair --color hair=#ffffff", "--color"),
        ("--color hair=brown", "hair=brown"),
        ("--undo --region hair", "--region"),
        ("--region hair --from gone.cnerf", "gone.cnerf"),
    ] {
        let run = folder.run(&format!("edit a.cnerf --model {MODEL} {options} --out x.cnerf"));
        assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{options}: {}", run.stderr);
        assert!(run.stderr.contains(said), "{options}: {}", run.stderr);
    }
    assert!(!folder.path("x.cnerf").exists());
}

#[test]
fn shells_and_readers_of_manuals_get_every_command() {
    let folder = Folder::new("shell");
    for line in ["completions bash", "completions fish", "man"] {
        let said = folder.run(line).done().stdout;
        for command in ["invert", "edit", "render", "export", "eval", "synth"] {
            assert!(said.contains(command), "`{line}` has no `{command}`");
        }
    }
}

#[test]
fn heads_are_seen_from_where_their_cameras_are_turned() {
    let folder = Folder::new("turns");
    folder.run("synth --count 2 --size 32 --turns -0.4,0.2 --out turned").done();
    let items = items(&folder, "turned");
    assert_eq!(items.len(), 6);
    for head in items.chunks_exact(3) {
        let turn = |index: usize| number(&head[index], "azimuth") - number(&head[0], "azimuth");
        assert!((turn(1) + 0.4).abs() < 1e-6 && (turn(2) - 0.2).abs() < 1e-6, "{head:?}");
        assert!(head.iter().all(|item| item["head"] == head[0]["head"]));
    }
    let refused = folder.run("synth --count 2 --size 32 --turns 2 --out far");
    assert_eq!((refused.code, refused.stderr.lines().count()), (2, 1), "{}", refused.stderr);
}

#[test]
fn animations_run_as_fast_as_told_and_meshes_hold_the_regions_named() {
    let folder = folder_with_portraits("frames");
    let line = format!("render a.cnerf --model {MODEL} --device cpu --frames 2 --fps 5");
    folder.run(&format!("{line} --out whole.gif")).done();
    folder.run(&format!("{line} --regions hair --out hair.gif")).done();
    let frames = |name: &str| {
        let decoder = GifDecoder::new(std::io::Cursor::new(folder.read(name))).unwrap();
        decoder.into_frames().collect_frames().unwrap()
    };
    let (whole, hair) = (frames("whole.gif"), frames("hair.gif"));
    assert!(whole.iter().all(|frame| frame.delay().numer_denom_ms() == (200, 1)));
    assert!(whole[0].buffer() != hair[0].buffer(), "--regions changes nothing");
    let vertices = |options: &str, out: &str| {
        let line = format!("export a.cnerf --model {MODEL} --device cpu --resolution 32 {options} --out {out}");
        number(&folder.json(&line), "vertices")
    };
    let (all, some) = (vertices("", "all.ply"), vertices("--regions hair", "hair.ply"));
    assert!(some > 0.0 && some < all, "{some} of {all} vertices");
}
