//! Real photos as people have them: turned by their camera, with several people, too dark, several at once; and face
//! parsers brought along.

use std::{
    fs,
    path::Path,
    process::Stdio,
    thread,
    time::{Duration, Instant},
};

use cnerf_tests::{Folder, MODEL, number};
use image::{RgbImage, codecs::jpeg::JpegEncoder, imageops};

/// Steps that show inversion works without waiting for a good likeness.
const FEW_STEPS: &str = "--pivot-steps 6 --tune-steps 1";

/// A JPEG whose EXIF block says how it is to be turned.
fn jpeg_with_orientation(picture: &RgbImage, orientation: u8) -> Vec<u8> {
    let mut jpeg = Vec::new();
    JpegEncoder::new_with_quality(&mut jpeg, 95).encode_image(picture).unwrap();
    // One TIFF directory, little-endian, of one entry: tag 0x112, a short.
    let mut exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0, 0]);
    let length = (exif.len() as u16 + 2).to_be_bytes();
    [&jpeg[..2], b"\xff\xe1", &length, &exif, &jpeg[2..]].concat()
}

/// The aligned photo: the first cell of the picture that `invert` writes.
fn aligned(folder: &Folder, name: &str) -> RgbImage {
    let strip = folder.picture(name);
    imageops::crop_imm(&strip, 0, 0, strip.height(), strip.height()).to_image()
}

#[test]
fn a_photo_is_turned_as_its_camera_says() {
    let folder = Folder::with_model("orientation");
    folder.photo("astronaut.png");
    let upright = folder.picture("astronaut.png");
    folder.write("upright.jpg", &jpeg_with_orientation(&upright, 1));
    folder.write("turned.jpg", &jpeg_with_orientation(&imageops::rotate270(&upright), 6));
    let report = folder.json(&format!("invert upright.jpg turned.jpg --model {MODEL} --out out {FEW_STEPS}"));
    assert_eq!(report["portraits"].as_array().map(Vec::len), Some(2), "{report}");
    let [one, two] = ["out/upright.png", "out/turned.png"].map(|name| aligned(&folder, name));
    let apart: u64 = one.iter().zip(two.iter()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    // Compressed along other axes, found again by the detector: the crops may differ by a fraction of a pixel.
    assert!(apart < 6 * one.len() as u64, "mean difference {}", apart as f64 / one.len() as f64);
}

#[test]
fn of_several_people_one_is_chosen_by_number() {
    let folder = Folder::with_model("faces");
    folder.photo("astronaut.png");
    let astronaut = folder.picture("astronaut.png");
    let mut pair = RgbImage::new(900, 512);
    let small = imageops::resize(&astronaut, 330, 330, imageops::FilterType::Triangle);
    imageops::replace(&mut pair, &small, 0, 0);
    imageops::replace(&mut pair, &astronaut, 380, 0);
    pair.save(folder.path("pair.png")).unwrap();
    let line = format!("invert pair.png --model {MODEL} {FEW_STEPS}");
    let run = folder.run(&format!("{line} --out first --no-progress")).done();
    assert!(run.stderr.contains("2 faces, number 0 is taken (0: ") && run.stderr.contains("; 1: "), "{}", run.stderr);
    assert!(run.stderr.contains("effort: about "), "the time is told ahead: {}", run.stderr);
    folder.run(&format!("{line} --face 1 --out second")).done();
    assert!(aligned(&folder, "first/pair.png") != aligned(&folder, "second/pair.png"), "the same face twice");
    let run = folder.run(&format!("{line} --face 2 --out third --quiet"));
    assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{}", run.stderr);
    assert!(run.stderr.contains("pair.png") && run.stderr.contains("1: "), "{}", run.stderr);
}

#[test]
fn dark_and_faceless_photos_fail_one_by_one() {
    let folder = Folder::with_model("dark");
    folder.photo("astronaut.png");
    let mut dark = folder.picture("astronaut.png");
    dark.iter_mut().for_each(|value| *value /= 12);
    dark.save(folder.path("dark.png")).unwrap();
    RgbImage::from_pixel(200, 200, image::Rgb([90, 120, 150])).save(folder.path("sky.png")).unwrap();
    let photos = "dark.png astronaut.png sky.png gone.png";
    let run = folder.run(&format!("invert {photos} --model {MODEL} --out out {FEW_STEPS} --json --quiet"));
    assert_eq!(run.code, 1, "{}", run.stderr);
    let report = run.json();
    assert_eq!(report["portraits"][0]["input"], "astronaut.png");
    let failed = report["failed"].as_array().unwrap();
    let said = |index: usize| failed[index]["error"].as_str().unwrap().to_owned();
    assert!(said(0).contains("dark.png") && (said(0).contains("dark (") || said(0).contains("no face")), "{}", said(0));
    assert!(said(1).contains("sky.png: no face found"), "{}", said(1));
    assert_eq!(said(2), "gone.png: no such file or folder; check its name");
    assert_eq!(folder.list("out"), ["astronaut.cnerf", "astronaut.png"]);
}

#[test]
fn photos_of_one_name_do_not_overwrite_each_other() {
    let folder = Folder::with_model("same_name");
    for place in ["a", "b"] {
        fs::create_dir(folder.path(place)).unwrap();
        folder.photo(&format!("{place}/me.png"));
    }
    let run = folder.run(&format!("invert a/me.png b/me.png --model {MODEL} --out out {FEW_STEPS} --overwrite"));
    assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{}", run.stderr);
    assert!(run.stderr.contains("a/me.png") && run.stderr.contains("b/me.png"), "{}", run.stderr);
}

#[test]
fn files_that_are_no_parsers_are_refused_in_a_line() {
    let folder = Folder::with_model("bad_parser");
    folder.photo("astronaut.png");
    folder.write("text.onnx", b"this is no network");
    folder.write("empty.onnx", b"");
    let line = format!("invert astronaut.png --model {MODEL} --out out {FEW_STEPS} --parser");
    for (option, said) in [
        ("text.onnx", "text.onnx"),
        ("empty.onnx", "empty.onnx"),
        ("gone.onnx", "no such file"),
        ("text.onnx --parser-classes hair,beard", "`beard`"),
    ] {
        let run = folder.run(&format!("{line} {option}"));
        assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{option}: {}", run.stderr);
        assert!(run.stderr.contains(said), "{option}: {}", run.stderr);
    }
    assert!(!folder.path("out").exists());
}

#[test]
fn regions_are_found_without_help_unless_nobody_is_to_look() {
    let folder = Folder::with_model("built_in_parser");
    folder.photo("astronaut.png");
    let line = format!("invert astronaut.png --model {MODEL} {FEW_STEPS}");
    let run = folder.run(&format!("{line} --out parsed --json --no-progress")).done();
    assert!(run.stderr.contains("regions parsed in"), "{}", run.stderr);
    assert!(number(&run.json()["portraits"][0], "mask_miou") > 0.0);
    let run = folder.run(&format!("{line} --parser none --out alone --json --no-progress")).done();
    assert!(!run.stderr.contains("regions parsed in"), "{}", run.stderr);
    assert!(run.json()["portraits"][0]["mask_miou"].is_null());
}

#[test]
fn a_map_made_by_hand_gives_the_regions_and_must_fit_the_photo() {
    let folder = Folder::with_model("mask");
    for (from, to) in [("images", "drawn.png"), ("masks", "mask.png")] {
        fs::copy(folder.path("../shared/data").join(from).join("00002.png"), folder.path(to)).unwrap();
    }
    let line = format!("invert drawn.png --aligned --model {MODEL} {FEW_STEPS} --overwrite --out");
    let by_hand = folder.json(&format!("{line} by_hand --mask mask.png"))["portraits"][0].clone();
    let unknown = folder.json(&format!("{line} unknown --parser none"))["portraits"][0].clone();
    assert!(number(&by_hand, "mask_miou") > 0.0 && unknown["mask_miou"].is_null(), "{by_hand} {unknown}");
    assert!(folder.read("by_hand/drawn.cnerf") != folder.read("unknown/drawn.cnerf"), "the map changes nothing");
    image::GrayImage::new(100, 64).save(folder.path("wide.png")).unwrap();
    let two = format!("invert drawn.png mask.png --aligned --model {MODEL} --out two");
    for (line, said) in [
        (format!("{line} wide --mask wide.png"), vec!["wide.png", "100x64", "64x64"]),
        (format!("{two} --mask mask.png"), vec!["--mask", "one photo"]),
        (format!("{two} --pose 0,0"), vec!["--pose", "one photo"]),
        (format!("{line} pose --pose 0.2"), vec!["--pose", "azimuth,elevation"]),
        (format!("{line} pose --pose 0.2,9"), vec!["--pose", "azimuth,elevation"]),
    ] {
        let run = folder.run(&line);
        assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{line}: {}", run.stderr);
        assert!(said.iter().all(|words| run.stderr.contains(words)), "{line}: {}", run.stderr);
    }
}

#[test]
fn small_faces_are_refused_and_crops_beyond_the_photo_are_mirrored_and_told() {
    let folder = Folder::with_model("framing");
    folder.photo("astronaut.png");
    let astronaut = folder.picture("astronaut.png");
    imageops::resize(&astronaut, 210, 210, imageops::FilterType::Triangle).save(folder.path("small.png")).unwrap();
    // Her crop reaches from about 137 to 312: a sixth of it is cut off.
    imageops::crop_imm(&astronaut, 168, 0, 344, 512).to_image().save(folder.path("cut.png")).unwrap();
    let line = format!("--model {MODEL} {FEW_STEPS} --no-progress --out out");
    let run = folder.run(&format!("invert small.png {line}"));
    assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{}", run.stderr);
    assert!(run.stderr.contains("small.png: the face is ") && run.stderr.contains("44"), "{}", run.stderr);
    let run = folder.run(&format!("invert cut.png {line}")).done();
    assert!(run.stderr.contains("of the crop lies beyond the photo, mirrored"), "{}", run.stderr);
}

#[test]
fn portraits_of_the_shipped_models_stay_small() {
    let folder = Folder::new("size");
    folder.photo("astronaut.png");
    for model in ["portrait", "cartoon"] {
        let line = format!("invert astronaut.png --model {model} --effort fast --pivot-steps 1 --tune-steps 1");
        folder.run(&format!("{line} --out {model}")).done();
        let bytes = folder.read(&format!("{model}/astronaut.cnerf")).len();
        assert!(bytes <= 2_000_000, "{model}: {bytes} bytes");
    }
}

#[test]
fn a_parser_is_trained_stopped_resumed_measured_and_used() {
    let folder = Folder::with_model("train_parser");
    folder.photo("astronaut.png");
    let line = "train-parser --data ../shared/data --batch 2 --cartoons 2 --steps 3 --seed 4 --quiet --out";
    folder.run(&format!("{line} run")).done();
    let said = folder.run(&format!("{line} run"));
    assert_eq!((said.code, said.stderr.lines().count()), (2, 1), "{}", said.stderr);
    assert!(said.stderr.contains("--resume"), "{}", said.stderr);
    let nothing_left =
        folder.json("train-parser --data ../shared/data --batch 2 --cartoons 2 --steps 3 --seed 4 --resume --out run");
    assert_eq!(nothing_left["interrupted"], false);
    folder.run(&format!("{line} again")).done();
    let parser = "run/parser.safetensors";
    assert!(folder.read(parser) == folder.read("again/parser.safetensors"), "the same seed gave another parser");
    let score =
        folder.json(&format!("eval parser --data ../shared/data --count 3 --parser {parser} --sheet sheet.png"));
    assert_eq!(number(&score, "count"), 3.0);
    assert!((0.0..=1.0).contains(&number(&score, "mean_iou")) && number(&score["pose"], "direction_rad") >= 0.0);
    assert_eq!(folder.picture("sheet.png").height() % (128 + 4), 4);
    let line = format!("invert astronaut.png --model {MODEL} {FEW_STEPS} --out out --parser");
    assert!(number(&folder.json(&format!("{line} {parser}"))["portraits"][0], "mask_miou") >= 0.0);
    for wrong in [MODEL, "gone.safetensors"] {
        let run = folder.run(&format!("{line} {wrong} --overwrite"));
        assert_eq!((run.code, run.stderr.lines().count()), (2, 1), "{wrong}: {}", run.stderr);
        assert!(run.stderr.contains(wrong), "{wrong}: {}", run.stderr);
    }
}

#[test]
fn a_face_parser_gives_the_regions() {
    let weights = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/weights/face_parser_bisenetv2_448.onnx");
    if !weights.exists() {
        println!("skipped: {} is absent", weights.display());
        return;
    }
    let folder = Folder::with_model("parser");
    folder.photo("astronaut.png");
    let line = format!("invert astronaut.png --model {MODEL} {FEW_STEPS}");
    assert!(folder.json(&format!("{line} --parser none --out plain"))["portraits"][0]["mask_miou"].is_null());
    let run = folder.run(&format!("{line} --parser {} --out parsed --json --no-progress", weights.display())).done();
    assert!(run.stderr.contains("regions parsed in"), "{}", run.stderr);
    assert!(number(&run.json()["portraits"][0], "mask_miou") > 0.0);
}

#[test]
fn photos_of_one_person_share_codes_and_keep_their_cameras() {
    let folder = Folder::with_model("same_person");
    folder.photo("left.png");
    imageops::flip_horizontal(&folder.picture("left.png")).save(folder.path("right.png")).unwrap();
    let line = format!("invert left.png right.png --same-person --model {MODEL} --out out {FEW_STEPS}");
    let report = folder.json(&line);
    assert_eq!(report["portraits"].as_array().map(Vec::len), Some(2), "{report}");
    let azimuth = |index: usize| number(&report["portraits"][index], "azimuth");
    assert!(azimuth(0) != azimuth(1), "each photo has its own camera");
    let codes = |name: &str| {
        let bytes = folder.read(name);
        let file = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        file.tensor("codes").unwrap().data().to_vec()
    };
    assert!(codes("out/left.cnerf") == codes("out/right.cnerf"), "one person, one set of codes");
}

/// Starts an inversion of face.png to `out` and waits for its first checkpoint.
fn started(folder: &Folder, out: &str, line: &str) -> std::process::Child {
    let mut command = folder.command(&format!("invert face.png --out {out} {line}"));
    let mut inversion = command.stderr(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let began = Instant::now();
    while !folder.path(out).join("face.cnerf.part").exists() {
        assert!(inversion.try_wait().unwrap().is_none(), "it ended without a checkpoint");
        assert!(began.elapsed() < Duration::from_secs(120), "no checkpoint was written");
        thread::sleep(Duration::from_millis(2));
    }
    inversion
}

#[test]
fn stopped_inversions_resume_to_the_same_portrait() {
    let folder = Folder::with_model("resume");
    folder.photo("face.png");
    let line = format!("--model {MODEL} --pivot-steps 160 --tune-steps 12 --no-progress");
    folder.run(&format!("invert face.png --out whole {line}")).done();
    assert_eq!(folder.list("whole"), ["face.cnerf", "face.png"], "the checkpoint goes when the portrait is there");

    let mut killed = started(&folder, "killed", &line);
    killed.kill().unwrap();
    killed.wait().unwrap();
    assert!(!folder.path("killed/face.cnerf").exists(), "it ended before it could be killed");
    let run = folder.run(&format!("invert face.png --out killed {line} --resume")).done();
    assert!(run.stderr.contains("goes on after step"), "{}", run.stderr);
    assert!(folder.read("killed/face.cnerf") == folder.read("whole/face.cnerf"), "the portraits differ");
    assert!(folder.read("killed/face.png") == folder.read("whole/face.png"), "the pictures differ");
    assert_eq!(folder.list("killed"), ["face.cnerf", "face.png"]);

    // What is finished stays; another setting is no continuation of this one.
    let report = folder.json(&format!("invert face.png --out killed {line} --resume"));
    assert_eq!(report["portraits"].as_array().map(Vec::len), Some(1), "{report}");
    fs::write(folder.path("killed/face.cnerf.part"), b"cut off").unwrap();
    fs::remove_file(folder.path("killed/face.cnerf")).unwrap();
    let run = folder.run(&format!("invert face.png --out killed {line} --resume"));
    assert_eq!(run.code, 2);
    assert!(run.stderr.contains("face.cnerf.part"), "{}", run.stderr);
}

#[cfg(unix)]
#[test]
fn ctrl_c_stops_an_inversion_and_says_how_to_go_on() {
    let folder = Folder::with_model("interrupt");
    folder.photo("face.png");
    let line = format!("--model {MODEL} --pivot-steps 400 --tune-steps 2 --no-progress");
    let interrupted = started(&folder, "out", &line);
    let id = interrupted.id().to_string();
    assert!(std::process::Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    let output = interrupted.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.lines().any(|line| line.contains("go on with: ") && line.ends_with("--resume")), "{said}");
    assert_eq!(folder.list("out"), ["face.cnerf.part"]);
    folder.run(&format!("invert face.png --out out {line} --resume")).done();
    assert_eq!(folder.list("out"), ["face.cnerf", "face.png"]);
}
