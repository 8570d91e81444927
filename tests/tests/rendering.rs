//! What `render` and `export` make of portraits: paths of the camera, blends, layers, budgets, random people, meshes.

use cnerf_tests::{DATA, Folder, MODEL, MODEL_SIZE, has_content, number};
use image::{RgbImage, imageops};

/// A folder with portraits of these names.
fn folder_with(name: &str, portraits: &[&str]) -> Folder {
    let folder = Folder::with_model(name);
    for (index, portrait) in portraits.iter().enumerate() {
        let drawn = folder.path(DATA).join(format!("images/0000{index}.png"));
        std::fs::copy(drawn, folder.path(&format!("{portrait}.png"))).unwrap();
        let few = "--aligned --pivot-steps 8 --tune-steps 2 --overwrite --out .";
        folder.run(&format!("invert {portrait}.png --model {MODEL} {few}")).done();
    }
    folder
}

/// Mean and largest difference of two pictures' bytes.
fn apart(a: &RgbImage, b: &RgbImage) -> (f64, u8) {
    assert_eq!(a.dimensions(), b.dimensions());
    let differences: Vec<u8> = a.iter().zip(b.iter()).map(|(a, b)| a.abs_diff(*b)).collect();
    let sum: f64 = differences.iter().map(|difference| f64::from(*difference)).sum();
    (sum / differences.len() as f64, differences.into_iter().max().unwrap())
}

fn refused(folder: &Folder, line: &str, said: &[&str]) {
    let run = folder.run(line);
    assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{line}: {}", run.stderr);
    assert!(said.iter().all(|words| run.stderr.contains(words)), "{line}: {}", run.stderr);
}

#[test]
fn the_camera_goes_where_a_file_says() {
    let folder = folder_with("path", &["a"]);
    let cameras = br#"[{"azimuth": -0.3, "elevation": 0}, {"azimuth": 0.3, "elevation": 0.1, "zoom": 1.5}]"#;
    folder.write("path.json", cameras);
    let line = format!("render a.cnerf --model {MODEL} --budget 0");
    assert_eq!(folder.json(&format!("{line} --trajectory path.json --out both"))["frames"], 2);
    assert_eq!(folder.json(&format!("{line} --trajectory path.json --frames 5 --out five"))["frames"], 5);
    let frame = |name: &str, index: usize| folder.picture(&format!("{name}/frame_{index:04}.png"));
    assert!(frame("both", 0) == frame("five", 0) && frame("both", 1) == frame("five", 4), "ends are the file's");
    assert!(frame("five", 2) != frame("five", 0) && frame("five", 2) != frame("five", 4));
    folder.json(&format!("{line} --trajectory sweep --frames 3 --out sweep"));
    folder.json(&format!("{line} --trajectory front --out front.png"));
    assert!(frame("sweep", 1) == folder.picture("front.png"), "the middle of a sweep is the front");
    folder.write("wrong.json", br#"[{"azimuth": 0, "elevation": 0, "rol": 1}]"#);
    refused(&folder, &format!("{line} --trajectory wrong.json --out x"), &["wrong.json", "rol"]);
    refused(&folder, &format!("{line} --trajectory gone.json --out x"), &["gone.json"]);
    refused(&folder, &format!("{line} --trajectory spiral --out x"), &["spiral", "orbit"]);
    refused(&folder, &format!("{line} --frames 0 --out x"), &["frames"]);
    refused(&folder, &format!("{line} --out x.avi"), &[".avi", ".gif"]);
}

#[test]
fn portraits_of_one_model_blend_and_others_are_told_apart() {
    let folder = folder_with("blend", &["a", "b"]);
    let line = format!("--model {MODEL} --trajectory front --budget 0");
    folder.json(&format!("render a.cnerf b.cnerf {line} --frames 3 --out blend"));
    for (portrait, frame) in [("a", 0), ("b", 2)] {
        folder.json(&format!("render {portrait}.cnerf {line} --out {portrait}_front.png"));
        let frame = folder.picture(&format!("blend/frame_000{frame}.png"));
        assert!(frame == folder.picture(&format!("{portrait}_front.png")), "{portrait} is an end of the blend");
    }
    let [first, middle, last] = [0, 1, 2].map(|frame| folder.picture(&format!("blend/frame_000{frame}.png")));
    let whole = apart(&first, &last).0;
    assert!(apart(&first, &middle).0 < whole && apart(&middle, &last).0 < whole, "the middle lies between");
    // The same architecture with other weights, each portrait with its own model.
    let tiny = format!("train --data {DATA} --preset tiny --seed 2 --quiet --stage upsampler");
    folder.run(&format!("{tiny} --model {MODEL} --set upsampler.steps=1 --out other")).done();
    let few = "--aligned --pivot-steps 2 --tune-steps 0 --overwrite --out .";
    std::fs::copy(folder.path(DATA).join("images/00000.png"), folder.path("c.png")).unwrap();
    folder.run(&format!("invert c.png --model other/model.safetensors {few}")).done();
    refused(&folder, "render a.cnerf c.cnerf --frames 3 --out x", &["a.cnerf", "c.cnerf", "different models"]);
}

#[test]
fn layers_stand_side_by_side() {
    let folder = folder_with("layers", &["a"]);
    let line = format!("render a.cnerf --model {MODEL} --trajectory front");
    folder.json(&format!("{line} --output rgb,seg,depth,normal --out all.png"));
    let all = folder.picture("all.png");
    assert_eq!(all.dimensions(), (4 * MODEL_SIZE, MODEL_SIZE));
    let layers =
        [0, 1, 2, 3].map(|layer| imageops::crop_imm(&all, layer * MODEL_SIZE, 0, MODEL_SIZE, MODEL_SIZE).to_image());
    for (index, layer) in layers.iter().enumerate() {
        assert!(has_content(layer) && !layers[..index].contains(layer), "layer {index}");
    }
    assert!(layers[2].pixels().all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]), "depth is grey");
    refused(&folder, &format!("{line} --output rgb,heat --out x.png"), &["heat", "normal"]);
}

#[test]
fn random_people_are_rendered_and_put_on_a_page_without_a_file() {
    let folder = Folder::with_model("seeds");
    folder.json(&format!("generate --model {MODEL} --seeds 3 --out random"));
    let line = format!("render --seed 3 --model {MODEL}");
    folder.json(&format!("{line} --trajectory front --out front.png"));
    assert!(folder.picture("front.png") == folder.picture("random/seed0003.png"), "`generate` shows the same");
    assert_eq!(folder.json(&format!("{line} --grid 3x3 --html page.html"))["frames"], 9);
    assert!(String::from_utf8(folder.read("page.html")).unwrap().contains("seed 3"));
    refused(&folder, &format!("render --model {MODEL} --out x.png"), &["--seed"]);
    refused(&folder, &format!("{line} --html x.htm"), &["x.htm", ".html"]);
    refused(&folder, &format!("{line} --grid 1x9 --html x.html"), &["--grid"]);
}

#[test]
fn budgets_are_kept_and_told() {
    let folder = folder_with("budget", &["a"]);
    let line = format!("render a.cnerf --model {MODEL} --trajectory front");
    let render = |budget: &str| {
        let report = folder.json(&format!("{line} --budget {budget} --out at{budget}.png"));
        (number(&report["plan"], "bound"), number(&report["plan"], "pairs_skipped"))
    };
    let (exact, budgeted) = (render("0"), render("0.01"));
    assert_eq!(exact, (0.0, 0.0));
    assert!(budgeted.0 > 0.0 && budgeted.0 <= 0.01 && budgeted.1 > 0.0, "{budgeted:?}");
    for budget in ["-1", "1.5", "much"] {
        refused(&folder, &format!("{line} --budget {budget} --out x.png"), &["--budget"]);
    }
}

#[test]
fn meshes_are_written_in_every_format() {
    let folder = folder_with("meshes", &["a"]);
    let line = format!("export a.cnerf --model {MODEL} --resolution 24");
    let report = folder.json(&format!("{line} --out head.obj"));
    let text = String::from_utf8(folder.read("head.obj")).unwrap();
    let lines = |start: &str| text.lines().filter(|line| line.starts_with(start)).count() as f64;
    assert_eq!((lines("v "), lines("f ")), (number(&report, "vertices"), number(&report, "triangles")));
    let vertex = text.lines().find(|line| line.starts_with("v ")).unwrap();
    assert_eq!(vertex.split_whitespace().count(), 7, "position and colour: {vertex}");
    folder.json(&format!("{line} --out head.ply"));
    let ply = folder.read("head.ply");
    assert!(String::from_utf8_lossy(&ply[..ply.len().min(1000)]).contains("property uchar region\n"));
    refused(&folder, &format!("{line} --out head.stl"), &["head.stl", ".glb"]);
    refused(&folder, &format!("{line} --resolution 4 --out x.ply"), &["--resolution"]);
}
