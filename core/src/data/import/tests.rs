//! Small sets in every form are imported, and what is wrong with one is named.

use image::GrayImage;

use super::*;
use crate::data::{dataset::Dataset, picture::RgbImage};

fn config(folder: &Path, format: MaskFormat) -> ImportConfig {
    let (images, masks) = (folder.join("photos"), folder.join("masks"));
    fs::create_dir_all(&images).unwrap();
    fs::create_dir_all(&masks).unwrap();
    ImportConfig { images, masks, format, classes: Vec::new(), cameras: None, resolution: None, jpeg: None }
}

fn photo(path: &Path, side: u32, red: u8) {
    picture::write(path, &RgbImage::from_pixel(side, side, image::Rgb([red, 0, 0]))).unwrap();
}

fn map(path: &Path, side: u32, labels: Vec<u8>) {
    fs::write(path, picture::encode_indices(&GrayImage::from_raw(side, side, labels).unwrap()).unwrap()).unwrap();
}

fn npy(path: &Path, shape: &str, kind: &str, data: &[u8]) {
    let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    fs::write(path, bytes).unwrap();
}

fn run(config: &ImportConfig, folder: &Path) -> Result<(ImportReport, Dataset)> {
    let mut writer = DatasetWriter::create(&folder.join("set.zip"), true)?;
    let report = import(config, &mut writer, &|done, total| assert!(done <= total))?;
    writer.finish()?;
    Ok((report, Dataset::open(folder.join("set.zip"))?))
}

fn labels(dataset: &Dataset, index: usize) -> Vec<u8> {
    dataset.mask(index).unwrap().unwrap().labels().to_vec()
}

#[test]
fn part_masks_are_laid_over_each_other() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), MaskFormat::CelebamaskParts);
    photo(&config.images.join("0.png"), 4, 10);
    photo(&config.images.join("1.png"), 4, 20);
    let part = |name: &str, on: [u8; 4]| {
        let picture = RgbImage::from_fn(2, 2, |x, y| image::Rgb([255 * on[(y * 2 + x) as usize]; 3]));
        let path = config.masks.join("0").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        picture::write(&path, &picture).unwrap();
    };
    part("00000_skin.png", [1, 1, 1, 0]);
    part("00000_eye_g.png", [0, 1, 0, 0]);
    part("00000_hair.png", [1, 0, 0, 0]);
    part("00000_neck_l.png", [0, 0, 0, 1]);
    let (report, dataset) = run(&config, folder.path()).unwrap();
    assert_eq!(labels(&dataset, 0), [7, 2, 1, 8]);
    // The photo was reduced to the masks' size; photo 1 has no parts.
    assert_eq!(dataset.item(0).unwrap().image.dimensions(), (2, 2));
    assert_eq!(dataset.entry(0).unwrap().extra["source"], "0.png");
    assert_eq!((report.written, report.failed.len()), (1, 1));
    assert!(report.failed[0].to_string().contains("1.png: no mask"));
    fs::remove_file(config.images.join("1.png")).unwrap();
    part("00000_tail.png", [0, 0, 0, 1]);
    assert!(run(&config, folder.path()).unwrap_err().to_string().contains("`tail`"));
}

#[test]
fn label_maps_need_their_classes_named() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config(folder.path(), MaskFormat::CelebamaskHq19);
    fs::create_dir_all(config.images.join("00000")).unwrap();
    photo(&config.images.join("00000/00007.png"), 2, 0);
    map(&config.masks.join("7.png"), 2, vec![1, 13, 2, 18]);
    let (_, dataset) = run(&config, folder.path()).unwrap();
    assert_eq!(labels(&dataset, 0), [1, 7, 5, 8]);
    config.classes = "background skin l_brow r_brow l_eye r_eye eye_g l_ear r_ear ear_r nose mouth u_lip hair"
        .split(' ')
        .map(String::from)
        .collect();
    config.resolution = Some(4);
    let error = run(&config, folder.path()).unwrap_err().to_string();
    assert!(error.contains("7.png: label 18"), "{error}");
    map(&config.masks.join("7.png"), 2, vec![1, 13, 2, 9]);
    let (_, dataset) = run(&config, folder.path()).unwrap();
    assert_eq!(labels(&dataset, 0), [1, 1, 7, 7, 1, 1, 7, 7, 3, 3, 6, 6, 3, 3, 6, 6]);
    config.format = MaskFormat::Cnerf9;
    config.classes.clear();
    assert!(run(&config, folder.path()).unwrap_err().to_string().contains("label 13"));
}

#[test]
fn the_authors_arrays_have_mouth_before_eyebrows() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), MaskFormat::AuthorsNpy);
    for number in 0..4 {
        photo(&config.images.join(format!("{number:05}.png")), 2, number);
    }
    // Channel 3 (mouth) at pixel 0, channel 4 (eyebrows) at pixel 1, face and hair overlapping at 2, nothing at 3.
    let mut channels = [0u8; 36];
    for (channel, pixel) in [(3, 0), (4, 1), (1, 2), (7, 2), (1, 0)] {
        channels[channel * 4 + pixel] = 1;
    }
    npy(&config.masks.join("00000.npy"), "9, 2, 2", "|b1", &channels);
    npy(&config.masks.join("00001.npy"), "2, 2", "|u1", &[3, 4, 8, 0]);
    npy(&config.masks.join("00002.npy"), "9, 4294967295, 4294967295", "|u1", &[0; 36]);
    npy(&config.masks.join("00003.npy"), "2, 2", "|u1", &[3, 4, 9, 0]);
    let (report, dataset) = run(&config, folder.path()).unwrap();
    assert_eq!(labels(&dataset, 0), [4, 3, 7, 0]);
    assert_eq!(labels(&dataset, 1), [4, 3, 8, 0]);
    let failed: Vec<String> = report.failed.iter().map(ToString::to_string).collect();
    assert!(failed[0].contains("00002.npy: shape") && failed[1].contains("00003.npy: label 9"), "{failed:?}");
}

#[test]
fn cameras_come_from_a_list() {
    let folder = tempfile::tempdir().unwrap();
    let mut config = config(folder.path(), MaskFormat::Cnerf9);
    for number in 0..2 {
        photo(&config.images.join(format!("{number:05}.png")), 2, 0);
        map(&config.masks.join(format!("{number:05}.png")), 2, vec![0; 4]);
    }
    let list = folder.path().join("cameras.json");
    let item = serde_json::json!({"image": "a/img00000001.png", "azimuth": 0.25, "elevation": -0.5});
    fs::write(&list, serde_json::json!({"labels": "cnerf-9", "items": [item]}).to_string()).unwrap();
    config.cameras = Some(list);
    let (report, dataset) = run(&config, folder.path()).unwrap();
    assert_eq!(dataset.camera(0).unwrap().map(|camera| camera.azimuth_rad), Some(0.25));
    assert!(report.failed[0].to_string().contains("00000.png: no camera"));
}

#[test]
fn bad_photos_are_left_out_by_name_and_none_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let config = config(folder.path(), MaskFormat::Cnerf9);
    assert!(run(&config, folder.path()).unwrap_err().to_string().contains("photos: holds no PNG"));
    photo(&config.images.join("1.png"), 2, 0);
    fs::write(config.images.join("2.jpg"), b"\xff\xd8\xff\xe0cut").unwrap();
    fs::write(config.images.join("001.jpg"), b"same number as 1.png").unwrap();
    for number in 1..3 {
        map(&config.masks.join(format!("{number}.png")), 2, vec![0; 4]);
    }
    fs::remove_file(config.images.join("001.jpg")).unwrap();
    photo(&config.images.join("00001.png"), 2, 0);
    let (report, _) = run(&config, folder.path()).unwrap();
    assert_eq!((report.written, report.failed.len()), (1, 2));
    let failed: Vec<String> = report.failed.iter().map(ToString::to_string).collect();
    assert!(failed[0].contains("1.png: has the number"), "{failed:?}");
    assert!(failed[1].contains("2.jpg: cannot be decoded"), "{failed:?}");
}
