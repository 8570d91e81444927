//! Datasets are written and read back, and hostile ones refused by name.

use std::{fs, io::Write as _};

use serde_json::json;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::*;

fn photo(seed: u8) -> RgbImage {
    RgbImage::from_fn(16, 16, |x, y| image::Rgb([seed, (x * 16) as u8, (y * 16) as u8]))
}

fn mask() -> LabelMap {
    LabelMap::new(16, 16, (0..256u32).map(|pixel| (pixel % 16 / 2) as u8).collect()).unwrap()
}

fn write_sample(path: &Path, count: u8) {
    let mut writer = DatasetWriter::create(path, false).unwrap();
    writer.set("license", "none");
    for seed in 0..count {
        let camera = Camera { roll_rad: 0.01, ..Camera::at(0.1 * f64::from(seed), -0.2) };
        let item = EncodedItem::new(&photo(seed), Some(&mask()), Some(camera), PhotoFormat::Png).unwrap();
        writer.add(item.with("glasses", seed == 1).attach("depth", "bin", vec![seed; 3])).unwrap();
    }
    writer.finish().unwrap();
}

fn zip_of(path: &Path, files: &[(&str, &[u8])], method: CompressionMethod) {
    let mut writer = ZipWriter::new(fs::File::create(path).unwrap());
    for (name, bytes) in files {
        writer.start_file(*name, SimpleFileOptions::default().compression_method(method)).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn folders_and_zips_round_trip_with_their_extra_fields() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["set", "set.zip"] {
        let path = folder.path().join(name);
        write_sample(&path, 3);
        let dataset = Dataset::open(&path).unwrap();
        assert_eq!(dataset.len(), 3);
        assert_eq!(dataset.extra()["license"], "none");
        for index in 0..3 {
            let item = dataset.item(index).unwrap();
            assert_eq!(item.image, photo(index as u8));
            assert_eq!(item.mask, Some(mask()));
            assert_eq!(item.camera.unwrap().azimuth_rad, 0.1 * index as f64);
            let entry = dataset.entry(index).unwrap();
            assert_eq!(entry.extra["glasses"], json!(index == 1));
            assert_eq!(dataset.file(entry.extra["depth"].as_str().unwrap()).unwrap(), vec![index as u8; 3]);
        }
        let report = dataset.check(&|_| {});
        assert!(report.problems.is_empty(), "{:?}", report.problems);
        assert_eq!((report.with_mask, report.with_camera, report.resolutions[&16]), (3, 3, 3));
        assert!((report.region_share[3] - 0.125).abs() < 1e-12);
        assert!(dataset.item(3).is_err());
    }
    // Nothing temporary is left behind.
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn the_same_content_is_the_same_zip() {
    let folder = tempfile::tempdir().unwrap();
    let [first, second] = ["a.zip", "b.zip"].map(|name| {
        write_sample(&folder.path().join(name), 2);
        fs::read(folder.path().join(name)).unwrap()
    });
    assert_eq!(first, second);
}

#[test]
fn existing_sets_are_replaced_only_when_told_to() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["set", "set.zip"] {
        let path = folder.path().join(name);
        write_sample(&path, 2);
        let error = DatasetWriter::create(&path, false).err().unwrap().to_string();
        assert!(error.contains("--overwrite"), "{error}");
        DatasetWriter::create(&path, true).unwrap().finish().unwrap();
        assert_eq!(Dataset::open(&path).unwrap().len(), 0);
    }
    let precious = folder.path().join("precious");
    fs::create_dir(&precious).unwrap();
    fs::write(precious.join("thesis.txt"), "words").unwrap();
    assert!(DatasetWriter::create(&precious, true).is_err());
}

#[test]
fn deflated_zips_are_read_and_threads_share_them() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deflated.zip");
    let png = picture::encode_png(&photo(5)).unwrap();
    let map = mask().encode().unwrap();
    let index = json!({"labels": "cnerf-9", "items": vec![json!({"image": "a.png", "mask": "m.png"}); 40]});
    let index = index.to_string();
    let files = [("a.png", &png[..]), ("m.png", &map[..]), ("dataset.json", index.as_bytes())];
    zip_of(&path, &files, CompressionMethod::Deflated);
    let dataset = Dataset::open(&path).unwrap();
    let same = (0..40usize).into_par_iter().all(|index| dataset.item(index).unwrap().image == photo(5));
    assert!(same);
    assert_eq!(dataset.camera(0).unwrap(), None);
    // 39 repeats of two names.
    assert_eq!(dataset.check(&|_| {}).problems.len(), 78);
}

#[test]
fn celebamask_maps_and_class_names_are_translated() {
    let folder = tempfile::tempdir().unwrap();
    let png = picture::encode_png(&RgbImage::new(2, 2)).unwrap();
    let map = picture::encode_indices(&image::GrayImage::from_raw(2, 2, vec![0, 13, 17, 3]).unwrap()).unwrap();
    fs::write(folder.path().join("i.png"), png).unwrap();
    fs::write(folder.path().join("m.png"), map).unwrap();
    let items = json!([{"image": "i.png", "mask": "m.png"}]);
    let index = json!({"labels": "celebamask-hq-19", "items": items});
    fs::write(folder.path().join("dataset.json"), index.to_string()).unwrap();
    let labels = |dataset: Dataset| dataset.mask(0).map(|mask| mask.unwrap().labels().to_vec());
    assert_eq!(labels(Dataset::open(folder.path()).unwrap()).unwrap(), [0, 7, 8, 2]);
    let mut classes = vec!["background"; 19];
    (classes[13], classes[17], classes[3]) = ("nose", "hat", "l_ear");
    let index = json!({"labels": "celebamask-hq-19", "classes": classes, "items": items});
    fs::write(folder.path().join("dataset.json"), index.to_string()).unwrap();
    assert_eq!(labels(Dataset::open(folder.path()).unwrap()).unwrap(), [0, 5, 7, 6]);
}

#[test]
fn stylegan_sets_are_read_with_the_masks_that_exist() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join("masks/00000")).unwrap();
    fs::write(folder.path().join("masks/00000/img1.png"), mask().encode().unwrap()).unwrap();
    let mut numbers = vec![0.0; 25];
    for (at, value) in [(0, 1.0), (5, -1.0), (10, -1.0), (11, 2.7), (15, 1.0), (24, 1.0)] {
        numbers[at] = value;
    }
    for (at, value) in [(16, 4.2647), (20, 4.2647), (18, 0.5), (21, 0.5)] {
        numbers[at] = value;
    }
    let index = json!({"labels": [["00000/img1.png", numbers], ["00000/img2.png", numbers]]});
    fs::write(folder.path().join("dataset.json"), index.to_string()).unwrap();
    let dataset = Dataset::open(folder.path()).unwrap();
    assert_eq!(dataset.entry(0).unwrap().mask.as_deref(), Some("masks/00000/img1.png"));
    assert_eq!(dataset.entry(1).unwrap().mask, None);
    let camera = dataset.camera(0).unwrap().unwrap();
    assert!(camera.azimuth_rad.abs() + camera.elevation_rad.abs() + camera.roll_rad.abs() < 1e-12);
    assert!((camera.zoom - 0.8965).abs() < 1e-3);
}

#[test]
fn every_bad_file_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let png = picture::encode_png(&photo(1)).unwrap();
    let map = mask().encode().unwrap();
    let small = LabelMap::new(2, 2, vec![0; 4]).unwrap().encode().unwrap();
    let range = picture::encode_indices(&image::GrayImage::from_pixel(16, 16, image::Luma([12]))).unwrap();
    let oblong = picture::encode_png(&RgbImage::new(8, 4)).unwrap();
    let files: [(&str, &[u8]); 7] = [
        ("good.png", &png),
        ("cut.png", &png[..png.len() / 2]),
        ("good_mask.png", &map),
        ("small_mask.png", &small),
        ("range_mask.png", &range),
        ("text.jpg", b"hello"),
        ("oblong.png", &oblong),
    ];
    for (name, bytes) in files {
        fs::write(path.join(name), bytes).unwrap();
    }
    let index = json!({"labels": "cnerf-9", "items": [
        {"image": "good.png", "mask": "good_mask.png"},
        {"image": "cut.png"},
        {"image": "missing.png"},
        {"image": "good.png", "mask": "small_mask.png"},
        {"image": "good.png", "mask": "range_mask.png"},
        {"image": "text.jpg"},
        {"image": "good.png", "azimuth": 15.0, "elevation": 0.0},
        {"image": "oblong.png"},
        {"image": "../secret.png"},
        {"image": "/etc/passwd"},
    ]});
    fs::write(path.join("dataset.json"), index.to_string()).unwrap();
    let report = Dataset::open(path).unwrap().check(&|_| {});
    let expected = [
        (1, "cut.png", "truncated"),
        (2, "missing.png", ""),
        (3, "small_mask.png", "2×2"),
        (3, "good.png", "listed twice"),
        (4, "range_mask.png", "label 12"),
        (4, "good.png", "listed twice"),
        (5, "text.jpg", "PNG, JPEG"),
        (6, "good.png", "radians"),
        (6, "good.png", "listed twice"),
        (7, "oblong.png", "square"),
        (8, "secret.png", "`..`"),
        (9, "passwd", "absolute"),
    ];
    let found: Vec<_> = report.problems.iter().map(|problem| (problem.index, problem.error.to_string())).collect();
    assert_eq!(found.len(), expected.len(), "{found:#?}");
    for ((index, message), (expected_index, file, reason)) in found.iter().zip(expected) {
        assert!(*index == expected_index && message.contains(file) && message.contains(reason), "{index} {message}");
        assert!(!message.contains('\n'));
    }
}

#[test]
fn hostile_zips_are_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let open = |name: &str, files: &[(&str, &[u8])]| {
        let path = folder.path().join(name);
        zip_of(&path, files, CompressionMethod::Deflated);
        Dataset::open(&path)
    };
    let empty = br#"{"labels": "cnerf-9", "items": []}"#;
    for (name, entry) in [("up.zip", "../evil.png"), ("root.zip", "/evil.png"), ("back.zip", "a\\..\\evil.png")] {
        let error = open(name, &[("dataset.json", empty), (entry, b"x")]).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains("pack the archive again"), "{error}");
    }
    let error = open("case.zip", &[("dataset.json", empty), ("A.png", b"x"), ("a.png", b"x")]).unwrap_err();
    assert!(error.to_string().contains("case.zip: entry `a.png` is there twice"), "{error}");

    // 100 MB of zeros in 100 kB.
    let bomb = vec![0u8; 100 << 20];
    let index = br#"{"labels": "cnerf-9", "items": [{"image": "bomb.png"}]}"#;
    let dataset = open("bomb.zip", &[("dataset.json", index), ("bomb.png", &bomb)]).unwrap();
    let error = dataset.item(0).unwrap_err().to_string();
    assert!(error.contains("bomb.zip/bomb.png") && error.contains("64 MiB"), "{error}");

    // The same with the declared size forged to 10 bytes, in the local header and in the directory.
    let path = folder.path().join("bomb.zip");
    let forged: Vec<u8> = {
        let mut bytes = fs::read(&path).unwrap();
        let size = (100u32 << 20).to_le_bytes();
        for at in 0..bytes.len() - 4 {
            if bytes[at..at + 4] == size {
                bytes[at..at + 4].copy_from_slice(&10u32.to_le_bytes());
            }
        }
        bytes
    };
    fs::write(&path, forged).unwrap();
    let error = Dataset::open(&path).and_then(|dataset| dataset.item(0)).unwrap_err().to_string();
    assert!(error.contains("bomb.zip"), "{error}");

    // Cut anywhere, the archive is refused.
    write_sample(&folder.path().join("whole.zip"), 2);
    let bytes = fs::read(folder.path().join("whole.zip")).unwrap();
    for kept in [0, 1, 30, bytes.len() / 2, bytes.len() - 10] {
        let path = folder.path().join("cut.zip");
        fs::write(&path, &bytes[..kept]).unwrap();
        let error = Dataset::open(&path).unwrap_err().to_string();
        assert!(error.contains("cut.zip"), "{error}");
    }
    // A flipped bit in a stored picture fails its checksum.
    let mut flipped = bytes;
    flipped[200] ^= 4;
    fs::write(folder.path().join("flip.zip"), flipped).unwrap();
    let dataset = Dataset::open(folder.path().join("flip.zip")).unwrap();
    assert!(dataset.item(0).unwrap_err().to_string().contains("flip.zip/images/00000.png"));
}

#[test]
fn wrong_types_in_the_index_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let cases = [
        ("[]", "object"),
        ("{", "not JSON"),
        (r#"{"items": []}"#, "`labels`"),
        (r#"{"labels": "coco", "items": []}"#, "`coco`"),
        (r#"{"labels": "cnerf-9"}"#, "`items`"),
        (r#"{"labels": "cnerf-9", "items": [3]}"#, "items[0] must be an object"),
        (r#"{"labels": "cnerf-9", "items": [{"image": 3}]}"#, "items[0].image"),
        (r#"{"labels": "cnerf-9", "items": [{"image": "a", "mask": []}]}"#, "items[0].mask"),
        (r#"{"labels": "cnerf-9", "items": [{"image": "a", "azimuth": "left"}]}"#, "items[0].azimuth"),
        (r#"{"labels": "cnerf-9", "items": [{"image": "a", "azimuth": 0.1}]}"#, "both or neither"),
        (r#"{"labels": "cnerf-9", "classes": ["tail"], "items": []}"#, "`tail`"),
        (r#"{"labels": "cnerf-9", "classes": 9, "items": []}"#, "`classes`"),
        (r#"{"labels": [["a.png", [1, 2]]]}"#, "labels[0]"),
        (r#"{"labels": [["a.png"]]}"#, "25 numbers"),
    ];
    for (text, expected) in cases {
        fs::write(folder.path().join("dataset.json"), text).unwrap();
        let error = Dataset::open(folder.path()).unwrap_err().to_string();
        assert!(error.contains("dataset.json") && error.contains(expected), "{text}: {error}");
    }
    let deep = format!("{{\"labels\": {}", "[".repeat(100_000));
    fs::write(folder.path().join("dataset.json"), deep).unwrap();
    assert!(Dataset::open(folder.path()).is_err());
    fs::remove_file(folder.path().join("dataset.json")).unwrap();
    assert!(Dataset::open(folder.path()).unwrap_err().to_string().contains("dataset import"));
}

#[test]
fn the_portraits_open_and_are_sound() {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/portraits/portraits_train.zip"));
    if !path.exists() {
        println!("skipped: {} is absent", path.display());
        return;
    }
    let start = std::time::Instant::now();
    let dataset = Dataset::open(path).unwrap();
    let opened = start.elapsed();
    let report = dataset.check(&|_| {});
    let seconds = start.elapsed().as_secs_f64();
    println!("opened in {opened:?}, {} items checked at {:.0}/s", report.items, report.items as f64 / seconds);
    assert_eq!((report.items, report.with_mask, report.with_camera), (902, 902, 902));
    assert!(report.problems.is_empty(), "{:?}", report.problems);
}
