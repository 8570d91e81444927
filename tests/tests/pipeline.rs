//! From nothing to an edited, animated, exported portrait, each step as a user types it, judged by what is in the files.

use std::{
    fs,
    io::Cursor,
    thread,
    time::{Duration, Instant},
};

use cnerf_tests::{DATA, Folder, MODEL, MODEL_SIZE, has_content, number};
use image::{AnimationDecoder as _, codecs::gif::GifDecoder};
use safetensors::SafeTensors;

/// Steps that show inversion works without waiting for a good likeness.
const FEW_STEPS: &str = "--pivot-steps 20 --tune-steps 4";

/// A folder with `portrait.cnerf`, inverted from a picture of the shared dataset.
fn folder_with_portrait(name: &str) -> Folder {
    let folder = Folder::with_model(name);
    fs::copy(folder.path(DATA).join("images/00003.png"), folder.path("portrait.png")).unwrap();
    folder.json(&format!("invert portrait.png --aligned --model {MODEL} --out . {FEW_STEPS} --overwrite"));
    folder
}

#[test]
fn synthetic_portraits_pass_the_dataset_check() {
    let folder = Folder::new("synth");
    folder.json("synth --count 6 --views 2 --size 64 --seed 3 --out data");
    folder.json("synth --count 3 --size 64 --seed 3 --out data.zip");
    let report = folder.json("dataset check data");
    assert_eq!((&report["items"], &report["with_mask"], &report["with_camera"]), (&12.into(), &12.into(), &12.into()));
    assert_eq!(report["problems"].as_array().map(Vec::len), Some(0));
    let share = &report["region_share"];
    let total: f64 = share.as_object().unwrap().values().filter_map(serde_json::Value::as_f64).sum();
    assert!((total - 1.0).abs() < 1e-9, "the regions' shares sum to {total}");
    assert!(number(share, "face") > 0.05 && number(share, "hair") > 0.02, "{share}");
    let mask = image::open(folder.path("data/masks/00000.png")).unwrap();
    let mask = mask.as_luma8().expect("masks are 8-bit label maps");
    assert!(mask.as_raw().iter().all(|&label| label < 9) && mask.as_raw().contains(&1));
    assert_eq!(folder.json("info data.zip")["items"], 3);
}

#[test]
fn training_all_stages_makes_a_whole_model() {
    let folder = Folder::with_model("train_all");
    let report = folder.json(&format!(
        "train --data {DATA} --out run --preset tiny --stage all --seed 1 --set warmup.steps=10 --set upsampler.steps=4"
    ));
    assert_eq!(report["interrupted"], false);
    let stages: Vec<String> = String::from_utf8(folder.read("run/log.jsonl"))
        .unwrap()
        .lines()
        .map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap()["stage"].to_string())
        .collect();
    for stage in ["warmup", "field", "upsampler"] {
        assert!(stages.contains(&format!("\"{stage}\"")), "no step of stage {stage} in the log");
    }
    let info = folder.json("info run/model.safetensors");
    assert_eq!(number(&info, "output_resolution"), f64::from(MODEL_SIZE));
}

#[test]
fn a_trained_model_holds_finite_weights_and_fits_better_than_at_the_start() {
    let folder = Folder::with_model("weights");
    let bytes = folder.read(MODEL);
    for (name, tensor) in SafeTensors::deserialize(&bytes).unwrap().tensors() {
        let mut values = tensor.data().chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap()));
        assert_eq!(tensor.dtype(), safetensors::Dtype::F32, "{name}");
        assert!(values.all(f32::is_finite), "{name} holds a number that is not finite");
    }
    let log = String::from_utf8(folder.read("../shared/warmup/log.jsonl")).unwrap();
    let masks: Vec<f64> = log
        .lines()
        .map(|line| number(&serde_json::from_str::<serde_json::Value>(line).unwrap()["metrics"], "masks"))
        .collect();
    assert!(masks[masks.len() - 1] < 0.5 * masks[0], "the mask loss went from {} to {:?}", masks[0], masks.last());
}

#[test]
fn generated_portraits_show_something_and_differ_by_seed() {
    let folder = Folder::with_model("generate");
    let report =
        folder.json(&format!("generate --model {MODEL} --seeds 0,4-5 --output rgb,seg --trunc 1 --out random"));
    assert_eq!(report["files"].as_array().map(Vec::len), Some(6));
    assert_eq!(folder.list("random").len(), 7, "three portraits, three region maps, a grid");
    let pictures = [0, 4, 5].map(|seed| folder.picture(&format!("random/seed{seed:04}.png")));
    for picture in &pictures {
        assert_eq!(picture.dimensions(), (MODEL_SIZE, MODEL_SIZE));
        assert!(has_content(picture));
    }
    assert!(pictures[0] != pictures[1] && pictures[1] != pictures[2]);
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_one_thread_and_two() {
    let folder = Folder::with_model("threads");
    for threads in [1, 2] {
        folder.run(&format!("synth --count 20 --size 48 --seed 5 --threads {threads} --out synth{threads}.zip")).done();
        fs::create_dir(folder.path(&format!("random{threads}"))).unwrap();
        let out = format!("--out random{threads} --threads {threads}");
        folder.run(&format!("generate --model {MODEL} --seeds 1-2 --output rgb,depth {out}")).done();
    }
    assert!(folder.read("synth1.zip") == folder.read("synth2.zip"), "synth depends on the thread count");
    for name in folder.list("random1") {
        let [one, two] = [1, 2].map(|threads| folder.read(&format!("random{threads}/{name}")));
        assert!(one == two, "{name} depends on the thread count");
    }
    folder.run("synth --count 20 --size 48 --seed 6 --out other.zip").done();
    assert!(folder.read("other.zip") != folder.read("synth1.zip"), "the seed changes nothing");
}

#[test]
fn a_killed_training_run_resumes_to_the_same_model() {
    let folder = Folder::with_model("resume");
    let settings = "--preset tiny --stage warmup --seed 1 --set warmup.steps=120 --set checkpoint_steps=10 --quiet";
    folder.run(&format!("train --data {DATA} --out whole {settings}")).done();
    let mut training = folder.command(&format!("train --data {DATA} --out halves {settings}")).spawn().unwrap();
    let began = Instant::now();
    let checkpoints = folder.path("halves/checkpoints");
    while !fs::read_dir(&checkpoints).is_ok_and(|mut entries| entries.next().is_some()) {
        assert!(began.elapsed() < Duration::from_secs(120), "no checkpoint was written");
        thread::sleep(Duration::from_millis(5));
    }
    training.kill().unwrap();
    training.wait().unwrap();
    assert!(!folder.path("halves/model.safetensors").exists(), "the run ended before it could be killed");
    folder.run(&format!("train --data {DATA} --out halves --stage warmup --resume --quiet")).done();
    assert!(folder.read("halves/model.safetensors") == folder.read("whole/model.safetensors"), "the models differ");
}

#[test]
fn a_dry_run_tells_configuration_time_and_memory_and_writes_nothing() {
    let folder = Folder::with_model("dry_run");
    let told = folder.json(&format!("train --data {DATA} --out run --preset tiny --dry-run"));
    assert_eq!(told["not_estimated"], serde_json::json!([]));
    let estimates = told["estimates"].as_array().unwrap();
    assert!(!estimates.is_empty());
    for estimate in estimates {
        assert!(number(estimate, "seconds") > 0.0 && number(estimate, "memory_bytes") > 1e6, "{estimate}");
    }
    // The paper's settings; its networks are too large to try out in a test, and a stage of no steps is not tried.
    let off = "--set field.steps=1 --set upsampler.steps=0 --set field.resolution=8 --set field.samples=2";
    let told = folder.json(&format!("train --data {DATA} --out run --preset ffhq {off} --dry-run"));
    let (config, field) = (&told["config"], &told["config"]["field"]);
    assert_eq!(number(&config["model"]["field"], "width"), 128.0);
    assert_eq!(number(&config["model"]["field"], "style_dim"), 256.0);
    assert_eq!((number(field, "generator_learning_rate"), number(field, "discriminator_learning_rate")), (2e-5, 2e-4));
    assert_eq!((number(field, "view"), number(field, "eikonal"), number(field, "minimal_surface")), (15.0, 0.1, 0.001));
    assert!(!folder.path("run").exists());
}

/// The labels of CelebAMask-HQ that stand for this program's nine regions.
const CELEBAMASK: [u8; 9] = [0, 1, 4, 6, 10, 2, 8, 13, 17];

#[test]
fn the_papers_preset_on_an_ffhq_like_set_resolves_to_the_papers_numbers() {
    let folder = Folder::with_model("ffhq");
    for part in ["ffhq", "ffhq/images", "ffhq/masks"] {
        fs::create_dir(folder.path(part)).unwrap();
    }
    for index in 0..5 {
        let name = format!("{index:05}.png");
        fs::copy(folder.path(DATA).join("images").join(&name), folder.path("ffhq/images").join(&name)).unwrap();
        let mut mask = image::load_from_memory(&folder.read(&format!("{DATA}/masks/{name}"))).unwrap().to_luma8();
        mask.pixels_mut().for_each(|pixel| pixel[0] = CELEBAMASK[usize::from(pixel[0])]);
        mask.save(folder.path("ffhq/masks").join(&name)).unwrap();
    }
    let import = "dataset import --images ffhq/images --masks ffhq/masks --format celebamask-hq-19 --out data";
    folder.run(import).done();
    // The upsampler's stage is not tried without a trained field: nothing of the paper's size is computed here.
    let told = folder.json("train --data data --out run --preset ffhq --stage upsampler --dry-run");
    assert_eq!((number(&told, "portraits"), told["estimates"].as_array().map(Vec::len)), (5.0, Some(0)));
    let config = &told["config"];
    let (model, field, upsampler) = (&config["model"], &config["field"], &config["upsampler"]);
    let is = |table: &serde_json::Value, expected: &[(&str, f64)]| {
        for (key, value) in expected {
            assert_eq!(number(table, key), *value, "{key} in {table}");
        }
    };
    is(&model["field"], &[("width", 128.0), ("style_dim", 256.0)]);
    is(model, &[("samples", 24.0)]);
    assert_eq!(model["camera_deviation_rad"], serde_json::json!([0.3, 0.15]));
    is(&model["upsampler"], &[("input_resolution", 64.0), ("output_resolution", 512.0)]);
    is(field, &[("resolution", 64.0), ("samples", 24.0)]);
    is(field, &[("generator_learning_rate", 2e-5), ("discriminator_learning_rate", 2e-4)]);
    assert_eq!(field["betas"], serde_json::json!([0.0, 0.9]));
    is(field, &[("r1_image", 10.0), ("r1_mask", 1000.0), ("semantic", 1.0), ("decoupling", 1.0)]);
    is(field, &[("view", 15.0), ("eikonal", 0.1), ("minimal_surface", 0.001)]);
    is(upsampler, &[("adversarial", 1.0), ("r1_image", 10.0), ("r1_mask", 1000.0), ("agreement", 0.0)]);
    // What the paper does not have is off.
    assert_eq!(number(&config["warmup"], "steps"), 0.0);
    assert_eq!((number(field, "augment_target"), number(upsampler, "augment_target")), (0.0, 0.0));
    for (key, form) in [("residual", "sum"), ("fusion", "raw"), ("background", "field"), ("density", "residual_sdf")] {
        assert_eq!(model["field"][key], form);
    }
}

#[test]
fn several_processes_without_mpi_are_refused() {
    let folder = Folder::with_model("processes");
    let mut training = folder.command(&format!("train --data {DATA} --out run --preset tiny"));
    let ended = training.env("OMPI_COMM_WORLD_SIZE", "2").stderr(std::process::Stdio::piped()).output().unwrap();
    assert_eq!(ended.status.code(), Some(2));
    let said = String::from_utf8(ended.stderr).unwrap();
    assert!(said.contains("--features mpi") && said.lines().count() == 1, "{said}");
    assert!(!folder.path("run").exists());
}

#[cfg(unix)]
#[test]
fn ctrl_c_ends_training_with_a_checkpoint_and_the_line_that_goes_on() {
    let folder = Folder::with_model("ctrl_c");
    let settings = "--preset tiny --stage warmup --seed 2 --set warmup.steps=120 --set log_steps=1 --quiet";
    folder.run(&format!("train --data {DATA} --out whole {settings}")).done();
    let mut command = folder.command(&format!("train --data {DATA} --out stopped {settings}"));
    let training = command.stdout(std::process::Stdio::piped()).spawn().unwrap();
    let (began, log) = (Instant::now(), folder.path("stopped/log.jsonl"));
    while !log.exists() {
        assert!(began.elapsed() < Duration::from_secs(120), "no step was logged");
        thread::sleep(Duration::from_millis(5));
    }
    let interrupted = std::process::Command::new("kill").args(["-INT", &training.id().to_string()]).status().unwrap();
    assert!(interrupted.success());
    let ended = training.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(1));
    let said = String::from_utf8(ended.stdout).unwrap();
    let (_, line) = said.trim().split_once("continue with: cnerf ").expect("a line that goes on");
    assert!(!folder.path("stopped/model.safetensors").exists(), "the run ended before it could be stopped");
    assert!(folder.list("stopped").iter().any(|name| name.starts_with("events.out.tfevents.")), "no TensorBoard file");
    folder.run(line).done();
    assert!(folder.read("stopped/model.safetensors") == folder.read("whole/model.safetensors"), "the models differ");
}

#[test]
fn inverting_a_synthetic_portrait_writes_a_portrait_file_that_resembles_it() {
    let folder = Folder::with_model("invert");
    fs::copy(folder.path(DATA).join("images/00003.png"), folder.path("drawn.png")).unwrap();
    let report = folder.json(&format!("invert drawn.png --aligned --model {MODEL} --out out {FEW_STEPS}"));
    assert_eq!(report["failed"].as_array().map(Vec::len), Some(0));
    let portrait = &report["portraits"][0];
    for key in ["seconds", "psnr", "ms_ssim", "azimuth", "elevation", "depth_drift"] {
        number(portrait, key);
    }
    // A flat grey picture reaches about 10 dB here.
    assert!(number(portrait, "psnr") > 11.0, "{portrait}");
    assert_eq!((&portrait["steps_pivot"], &portrait["steps_tune"]), (&20.into(), &4.into()));
    assert!(portrait["lpips"].is_null(), "no perceptual weights were given");
    assert_eq!(folder.list("out"), ["drawn.cnerf", "drawn.png"]);
    let strip = folder.picture("out/drawn.png");
    assert!(strip.width() >= 7 * MODEL_SIZE, "photo, pivot, tuned, regions, depth and two views");
    let info = folder.json("info out/drawn.cnerf");
    assert_eq!((&info["kind"], &info["source"]), (&"portrait".into(), &"drawn.png".into()));
    assert_eq!(number(&info["metrics"], "psnr"), number(portrait, "psnr"));
}

#[test]
fn the_real_photo_is_aligned_and_inverted() {
    let folder = Folder::with_model("photo");
    folder.photo("astronaut.png");
    let aligned = folder.json("dataset align astronaut.png --size 64 --out aligned");
    assert_eq!(aligned["aligned"], 1);
    let face = folder.picture("aligned/images/00000.jpg");
    assert_eq!(face.dimensions(), (64, 64));
    // The face is where portraits have it: skin, redder than blue, fills the middle of the picture.
    let middle = (26..38).flat_map(|y| (26..38).map(move |x| (x, y)));
    let skin = middle.filter(|&(x, y)| face.get_pixel(x, y)[0] > face.get_pixel(x, y)[2].saturating_add(10)).count();
    assert!(skin > 100, "{skin} of 144 pixels in the middle are skin");
    let few = "--effort fast --pivot-steps 30 --tune-steps 4";
    let report = folder.json(&format!("invert astronaut.png --model {MODEL} --out out {few}"));
    let portrait = &report["portraits"][0];
    assert!(number(portrait, "psnr") > 8.0, "{portrait}");
    assert!(number(portrait, "azimuth").abs() < 0.8 && number(portrait, "elevation").abs() < 0.6, "{portrait}");
    assert!(folder.path("out/astronaut.cnerf").is_file());
}

#[test]
fn a_texture_edit_of_hair_leaves_the_shape_and_is_undone_exactly() {
    let folder = folder_with_portrait("edit");
    let line = format!("edit portrait.cnerf --model {MODEL} --region hair --texture --seed 3 --out edited.cnerf");
    let report = folder.json(&line);
    assert_eq!(number(&report, "depth_change"), 0.0);
    assert!(number(&report, "inside_change") > 0.0, "{report}");
    assert!(number(&report, "outside_change") < number(&report, "inside_change"), "{report}");
    number(&report, "seconds");
    assert!(has_content(&folder.picture("edited.png")));
    let edits = &folder.json("info edited.cnerf")["edits"];
    assert_eq!(edits.as_array().map(Vec::len), Some(1));
    assert_eq!((&edits[0]["edit"]["regions"], &edits[0]["edit"]["aspect"]), (&"hair".into(), &"texture".into()));

    folder.run(&format!("edit edited.cnerf --undo --model {MODEL} --out undone.cnerf")).done();
    assert_eq!(folder.json("info undone.cnerf")["edits"].as_array().map(Vec::len), Some(0));
    let [before, edited, undone] = ["portrait", "edited", "undone"].map(|name| {
        folder
            .run(&format!("render {name}.cnerf --model {MODEL} --trajectory front --frames 1 --out {name}_front.png"))
            .done();
        folder.read(&format!("{name}_front.png"))
    });
    assert!(before != edited, "the edit cannot be seen");
    assert!(before == undone, "undo does not give the portrait back");
}

#[test]
fn a_shape_edit_moves_the_surface() {
    let folder = folder_with_portrait("shape");
    let report =
        folder.json(&format!("edit portrait.cnerf --model {MODEL} --region hair --shape --seed 3 --out edited.cnerf"));
    assert!(number(&report, "depth_change") > 0.0, "{report}");
}

#[test]
fn a_portrait_is_rendered_as_an_animation_and_as_frames() {
    let folder = folder_with_portrait("render");
    let line = format!("render portrait.cnerf --model {MODEL} --trajectory orbit");
    let report = folder.json(&format!("{line} --frames 5 --out orbit.gif"));
    assert_eq!(report["frames"], 5);
    let animation = GifDecoder::new(Cursor::new(folder.read("orbit.gif"))).unwrap();
    let frames = animation.into_frames().collect_frames().unwrap();
    assert_eq!(frames.len(), 5);
    assert_eq!(frames[0].buffer().dimensions(), (MODEL_SIZE, MODEL_SIZE));
    assert!(frames[0].buffer() != frames[1].buffer(), "the camera does not move");

    folder.json(&format!("{line} --frames 3 --output rgb,depth --out frames"));
    assert_eq!(folder.list("frames"), ["frame_0000.png", "frame_0001.png", "frame_0002.png"]);
    let frame = folder.picture("frames/frame_0001.png");
    assert!(has_content(&frame) && frame.width() >= 2 * MODEL_SIZE, "portrait and depth side by side");
}

#[test]
fn the_exported_mesh_is_closed_and_its_files_agree_with_the_report() {
    let folder = folder_with_portrait("export");
    let report = folder.json(&format!("export portrait.cnerf --model {MODEL} --resolution 32 --out head.ply"));
    assert_eq!(report["boundary_edges"], 0, "the surface has holes: {report}");
    let (vertices, triangles) = (number(&report, "vertices"), number(&report, "triangles"));
    assert!(vertices > 100.0 && triangles > 100.0, "{report}");
    let ply = folder.read("head.ply");
    let header = String::from_utf8_lossy(&ply[..ply.len().min(1000)]).into_owned();
    assert!(header.starts_with("ply\n"));
    assert!(header.contains(&format!("element vertex {vertices}\n")), "{header}");
    assert!(header.contains(&format!("element face {triangles}\n")), "{header}");

    folder.json(&format!("export portrait.cnerf --model {MODEL} --resolution 32 --out head.glb"));
    let glb = folder.read("head.glb");
    let word = |at: usize| u32::from_le_bytes(glb[at..at + 4].try_into().unwrap()) as usize;
    assert_eq!(&glb[..4], b"glTF");
    assert_eq!((word(4), word(8)), (2, glb.len()), "version and length");
    let scene: serde_json::Value = serde_json::from_slice(&glb[20..20 + word(12)]).unwrap();
    assert!(scene["meshes"].as_array().is_some_and(|meshes| !meshes.is_empty()), "{scene}");
}
