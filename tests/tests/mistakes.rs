//! The mistakes people make, and files made to do harm: one line that names the culprit and the remedy, exit code 2,
//! and nothing left behind.

use std::{
    fs,
    io::{Cursor, Write as _},
};

use cnerf_tests::{DATA, Folder, MODEL};
use image::{Rgb, RgbImage};
use zip::{ZipWriter, write::SimpleFileOptions};

/// A folder's content: every file's name, and its bytes.
fn content(folder: &Folder) -> Vec<(String, Option<Vec<u8>>)> {
    let names = folder.list(".");
    names.into_iter().map(|name| (fs::read(folder.path(&name)).ok(), name)).map(|(bytes, name)| (name, bytes)).collect()
}

/// Runs a command that must be refused: exit code 2, nothing on stdout, no file made or changed, and an error that says
/// all of `said`.
fn refused(folder: &Folder, line: &str, said: &[&str]) -> String {
    let before = content(folder);
    let run = folder.run(line);
    assert_eq!(run.code, 2, "`cnerf {line}` ended with {}: {}{}", run.code, run.stdout, run.stderr);
    assert_eq!(run.stdout, "", "`cnerf {line}`");
    for words in said {
        assert!(run.stderr.contains(words), "`cnerf {line}` does not say `{words}`: {}", run.stderr);
    }
    assert!(!run.stderr.contains("panicked"), "`cnerf {line}`: {}", run.stderr);
    assert!(content(folder) == before, "`cnerf {line}` left something behind: {:?}", folder.list("."));
    run.stderr
}

/// As [`refused`], and the error is one line.
fn refused_in_a_line(folder: &Folder, line: &str, said: &[&str]) {
    let error = refused(folder, line, said);
    assert_eq!(error.lines().count(), 1, "`cnerf {line}`: {error}");
    assert!(error.starts_with("error: "), "{error}");
}

/// A zip archive with these entries, names unchecked.
fn archive(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
        writer.start_file(*name, options).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

/// A folder with `portrait.cnerf`, made with the shared model.
fn folder_with_portrait(name: &str) -> Folder {
    let folder = Folder::with_model(name);
    fs::copy(folder.path(DATA).join("images/00000.png"), folder.path("portrait.png")).unwrap();
    let few = "--aligned --pivot-steps 2 --tune-steps 1 --overwrite --out .";
    folder.run(&format!("invert portrait.png --model {MODEL} {few}")).done();
    folder
}

#[test]
fn a_typo_in_an_option_names_the_option_meant() {
    let folder = Folder::new("typo");
    refused_in_a_line(&folder, "generate --sedes 1 --out random", &["--sedes", "--seeds"]);
    refused_in_a_line(&folder, "generat --out random", &["generat", "generate"]);
    refused_in_a_line(&folder, "synth --count many --out data", &["many", "--count"]);
}

#[test]
fn an_unknown_region_lists_the_regions() {
    let folder = Folder::new("region");
    let line = "edit portrait.cnerf --region hair,eyez --seed 1 --out edited.cnerf";
    refused_in_a_line(&folder, line, &["--region", "`eyez`", "eyes", "hair", "skin"]);
}

#[test]
fn a_typo_in_a_setting_lists_the_settings_there_are() {
    let folder = Folder::with_model("set");
    let train = format!("train --data {DATA} --preset tiny --out run --set");
    refused_in_a_line(&folder, &format!("{train} warmup.stepz=4"), &["warmup.stepz", "steps"]);
    refused_in_a_line(&folder, &format!("{train} warmup.steps"), &["warmup.steps", "key=value"]);
    refused_in_a_line(&folder, &format!("{train} warmup.steps=few"), &["warmup.steps"]);
}

#[test]
fn a_missing_file_is_named() {
    let folder = Folder::with_model("missing");
    refused_in_a_line(
        &folder,
        "edit nobody.cnerf --region hair --seed 1 --out edited.cnerf",
        &["nobody.cnerf: no such file", "check its name"],
    );
    refused_in_a_line(&folder, "train --data nowhere --preset tiny --out run", &["nowhere"]);
    refused_in_a_line(
        &folder,
        "generate --model nothing.safetensors --out random",
        &["nothing.safetensors", "portrait"],
    );
    refused_in_a_line(&folder, "info nothing", &["nothing"]);
    refused_in_a_line(&folder, &format!("invert nobody.png --model {MODEL} --out out"), &["nobody.png: no such file"]);
}

#[test]
fn a_truncated_image_is_named() {
    let folder = Folder::with_model("truncated_image");
    folder.photo("whole.png");
    folder.write("cut.png", &folder.read("whole.png")[..3000]);
    refused_in_a_line(
        &folder,
        &format!("invert cut.png --model {MODEL} --out out"),
        &["cut.png", "truncated", "replace"],
    );
}

#[test]
fn a_photo_without_a_face_says_so_and_what_to_do() {
    let folder = Folder::with_model("no_face");
    RgbImage::from_pixel(128, 128, Rgb([200, 200, 200])).save(folder.path("blank.png")).unwrap();
    let said = ["blank.png", "no face", "--aligned"];
    refused_in_a_line(&folder, &format!("invert blank.png --model {MODEL} --out out"), &said);
}

#[test]
fn an_image_header_that_claims_20000_by_20000_pixels_is_refused_unread() {
    let folder = Folder::with_model("huge");
    // Signature and IHDR: 20,000 × 20,000 pixels, 8-bit RGB, with its checksum; then no pixels at all.
    let mut png = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x4e\x20\0\0\x4e\x20\x08\x02\0\0\0\x6c\x12\xd1\x6e".to_vec();
    png.extend(b"\0\0\0\0IEND\xae\x42\x60\x82");
    folder.write("huge.png", &png);
    let line = format!("invert huge.png --aligned --model {MODEL} --out out");
    refused_in_a_line(&folder, &line, &["huge.png", "20000", "8192"]);
}

#[test]
fn a_portrait_is_not_opened_with_another_model() {
    let folder = folder_with_portrait("wrong_model");
    let other = "../shared/warmup/model.safetensors";
    let said = ["portrait.cnerf", "hash", "--model"];
    let edit = format!("edit portrait.cnerf --model {other} --region hair --seed 1 --out edited.cnerf");
    refused_in_a_line(&folder, &edit, &said);
    refused_in_a_line(&folder, &format!("render portrait.cnerf --model {other} --out orbit.gif"), &said);
    refused_in_a_line(&folder, &format!("export portrait.cnerf --model {other} --out head.glb"), &said);
}

#[test]
fn nothing_that_exists_is_replaced_unless_asked() {
    let folder = folder_with_portrait("overwrite");
    for name in ["edited.cnerf", "orbit.gif", "head.glb", "data.zip"] {
        folder.write(name, b"precious");
    }
    let edit = format!("edit portrait.cnerf --model {MODEL} --region hair --seed 1 --out edited.cnerf");
    let again = ["exists", "--overwrite"];
    refused_in_a_line(&folder, &edit, &again);
    refused_in_a_line(&folder, &format!("render portrait.cnerf --model {MODEL} --frames 2 --out orbit.gif"), &again);
    refused_in_a_line(&folder, &format!("export portrait.cnerf --model {MODEL} --out head.glb"), &again);
    refused_in_a_line(&folder, "synth --count 2 --size 64 --out data.zip", &again);
    refused_in_a_line(&folder, &format!("invert portrait.png --aligned --model {MODEL} --out ."), &again);
    refused_in_a_line(&folder, &format!("train --data {DATA} --preset tiny --out ../shared/model"), &["--resume"]);
    folder.run(&format!("{edit} --overwrite")).done();
    assert!(folder.read("edited.cnerf") != b"precious");
}

#[test]
fn an_archive_whose_names_climb_out_is_refused() {
    let folder = Folder::new("climbing_zip");
    let index = br#"{"labels": "cnerf-9", "items": [{"image": "images/00000.png"}]}"#;
    folder.write("climbing.zip", &archive(&[("dataset.json", index), ("../climbed.png", b"out")]));
    refused_in_a_line(&folder, "dataset check climbing.zip", &["climbing.zip", "../climbed.png"]);
    refused_in_a_line(&folder, "train --data climbing.zip --preset tiny --out run", &["climbing.zip"]);
    assert!(!folder.path("../climbed.png").exists());
}

#[test]
fn a_truncated_model_is_named() {
    let folder = Folder::with_model("truncated_model");
    let whole = folder.read(MODEL);
    folder.write("cut.safetensors", &whole[..whole.len() / 2]);
    refused_in_a_line(&folder, "info cut.safetensors", &["cut.safetensors", "again"]);
    refused_in_a_line(&folder, "generate --model cut.safetensors --out random", &["cut.safetensors", "again"]);
}

#[test]
fn a_checkpoint_that_would_run_a_command_is_refused_unrun() {
    let folder = Folder::new("hostile_checkpoint");
    // Pickle: protocol 2, push `os.system`, push its argument, make a tuple, call, stop.
    let pickle = b"\x80\x02cos\nsystem\nX\x0c\x00\x00\x00touch harmed\x85R.";
    folder.write("hostile.pt", &archive(&[("archive/data.pkl", pickle), ("archive/version", b"3\n")]));
    refused_in_a_line(&folder, "convert hostile.pt --out model.safetensors", &["hostile.pt", "os.system"]);
    assert!(!folder.path("harmed").exists(), "the command was run");
}

#[test]
fn one_bad_photo_of_two_costs_only_itself() {
    let folder = Folder::with_model("one_of_two");
    fs::copy(folder.path(DATA).join("images/00000.png"), folder.path("good.png")).unwrap();
    folder.write("bad.png", b"not a picture");
    let few = "--aligned --pivot-steps 2 --tune-steps 1";
    let run = folder.run(&format!("invert bad.png good.png --model {MODEL} --out out {few} --json --quiet"));
    assert_eq!(run.code, 1, "{}", run.stderr);
    let report = run.json();
    assert_eq!(report["portraits"].as_array().map(Vec::len), Some(1));
    assert_eq!(report["portraits"][0]["input"], "good.png");
    assert_eq!(report["failed"].as_array().map(Vec::len), Some(1));
    assert_eq!(report["failed"][0]["input"], "bad.png");
    assert!(report["failed"][0]["error"].as_str().is_some_and(|error| error.contains("bad.png")), "{report}");
    assert_eq!(folder.list("out"), ["good.cnerf", "good.png"]);
}
