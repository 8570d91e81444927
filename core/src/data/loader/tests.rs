use std::{collections::HashSet, path::Path};

use super::*;
use crate::data::{
    dataset::{DatasetWriter, EncodedItem, PhotoFormat},
    labels::LabelMap,
    picture::RgbImage,
};

const COUNT: usize = 10;

fn sample(folder: &Path, side: u32) -> Arc<Dataset> {
    let path = folder.join("set.zip");
    let mut writer = DatasetWriter::create(&path, true).unwrap();
    for index in 0..COUNT as u8 {
        // Red names the item, green the column.
        let image = RgbImage::from_fn(side, side, |x, _| image::Rgb([10 * index, (255 * x / (side - 1)) as u8, 0]));
        let labels = (0..side * side).map(|pixel| (pixel % side * 9 / side) as u8).collect();
        let mask = LabelMap::new(side, side, labels).unwrap();
        let camera = Camera { roll_rad: 0.1, ..Camera::at(0.05 * f64::from(index), 0.02) };
        writer.add(EncodedItem::new(&image, Some(&mask), Some(camera), PhotoFormat::Png).unwrap()).unwrap();
    }
    writer.finish().unwrap();
    Arc::new(Dataset::open(path).unwrap())
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

#[test]
fn batches_depend_on_seed_and_step_alone() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = sample(folder.path(), 18);
    let config =
        |workers, seed| LoaderConfig { resolutions: vec![9, 18], batch: 4, workers, seed, ..Default::default() };
    let stream = |workers, seed, step: u64, count: usize| -> Vec<Batch> {
        let loader = Loader::resume(Arc::clone(&dataset), &config(workers, seed), step).unwrap();
        loader.take(count).map(Result::unwrap).collect()
    };
    let reference = stream(1, 7, 0, 12);
    let compare = |found: Vec<Batch>, expected: &[Batch]| {
        for (found, expected) in found.iter().zip(expected) {
            assert_eq!((found.step, &found.draws, &found.cameras), (expected.step, &expected.draws, &expected.cameras));
            for (found, expected) in found.levels.iter().zip(&expected.levels) {
                assert_eq!(values(&found.images), values(&expected.images));
                assert_eq!(values(&found.masks), values(&expected.masks));
            }
        }
    };
    compare(stream(3, 7, 0, 12), &reference);
    compare(stream(2, 7, 5, 7), &reference[5..]);
    assert_ne!(stream(1, 8, 0, 1)[0].draws, reference[0].draws);
    // Ten items make one epoch: each exactly once, mirrored or not.
    let draws: Vec<Draw> = reference.iter().flat_map(|batch| batch.draws.clone()).collect();
    for epoch in draws.chunks_exact(COUNT) {
        assert_eq!(epoch.iter().map(|draw| draw.index).collect::<HashSet<_>>().len(), COUNT);
    }
    assert!(draws.iter().any(|draw| draw.mirrored) && draws.iter().any(|draw| !draw.mirrored));
}

#[test]
fn mirroring_flips_pixels_labels_and_camera_together() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = sample(folder.path(), 18);
    let config = LoaderConfig { resolutions: vec![18], batch: 16, ..LoaderConfig::default() };
    let batch = Loader::new(dataset, &config).unwrap().next_batch().unwrap();
    let level = batch.at(18).unwrap();
    assert_eq!((level.images.dims(), level.masks.dims()), (&[16, 3, 18, 18][..], &[16, 9, 18, 18][..]));
    assert!(batch.at(64).is_err());
    let (images, masks) = (values(&level.images), values(&level.masks));
    for (place, draw) in batch.draws.iter().enumerate() {
        let camera = batch.cameras[place];
        let sign = if draw.mirrored { -1.0 } else { 1.0 };
        assert_eq!(camera.azimuth_rad, sign * 0.05 * draw.index as f64);
        assert_eq!((camera.elevation_rad, camera.roll_rad), (0.02, sign * 0.1));
        assert_eq!(images[place * 3 * 324], picture::signed(10 * draw.index as u8));
        assert_eq!(images[place * 3 * 324 + 324], -sign as f32);
        let region = if draw.mirrored { 8 } else { 0 };
        assert_eq!(masks[place * 9 * 324 + region * 324], 1.0);
    }
}

#[test]
fn a_cached_set_gives_the_loaders_batches() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = sample(folder.path(), 20);
    let config = LoaderConfig { resolutions: vec![7, 10], batch: 6, seed: 3, ..LoaderConfig::default() };
    let streamed = Loader::resume(Arc::clone(&dataset), &config, 2).unwrap().next_batch().unwrap();
    let cached = Cached::new(&dataset, &config.resolutions, &|_| {}).unwrap();
    let draws = Order::new(3, COUNT, true).batch(2, 6);
    let batch = cached.batch(2, &draws).unwrap();
    assert_eq!((&batch.draws, &batch.cameras), (&streamed.draws, &streamed.cameras));
    for (found, expected) in batch.levels.iter().zip(&streamed.levels) {
        assert_eq!(values(&found.images), values(&expected.images));
        let masks = values(&found.masks);
        let difference = masks.iter().zip(values(&expected.masks)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(difference <= 0.5 / 255.0 + 1e-6);
        let level = cached.level(found.resolution).unwrap();
        let side = level.resolution();
        let pixels = values(&found.images);
        for (place, &draw) in draws.iter().enumerate() {
            let (colour, shares) = level.pixel(draw, 2, 5).unwrap();
            let at = |channels, channel| (place * channels + channel) * side * side + 5 * side + 2;
            assert_eq!(picture::signed(colour[1]), pixels[at(3, 1)]);
            assert_eq!(f32::from(shares[3]) / 255.0, masks[at(9, 3)]);
        }
    }
    assert!(cached.batch(0, &[Draw { index: COUNT, mirrored: false }]).is_err());
    assert!(cached.level(7).unwrap().pixel(Draw { index: 0, mirrored: true }, 7, 0).is_none());
}

#[test]
fn a_bad_item_is_named_and_the_stream_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("set");
    let mut writer = DatasetWriter::create(&path, false).unwrap();
    let mask = LabelMap::new(4, 4, vec![0; 16]).unwrap();
    for _ in 0..2 {
        let camera = Some(Camera::default());
        writer.add(EncodedItem::new(&RgbImage::new(4, 4), Some(&mask), camera, PhotoFormat::Png).unwrap()).unwrap();
    }
    writer.finish().unwrap();
    std::fs::write(path.join("images/00001.png"), b"\x89PNG\r\n\x1a\n").unwrap();
    let dataset = Arc::new(Dataset::open(&path).unwrap());
    let config = LoaderConfig { batch: 1, resolutions: vec![4], ..LoaderConfig::default() };
    let results: Vec<_> = Loader::new(dataset, &config).unwrap().take(4).collect();
    assert_eq!(results.iter().filter(|result| result.is_ok()).count(), 2);
    let errors: Vec<_> = results.into_iter().filter_map(Result::err).collect();
    assert!(errors.iter().all(|error| error.to_string().contains("images/00001.png")), "{errors:?}");
}

#[test]
fn sets_without_masks_or_cameras_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("set");
    let mut writer = DatasetWriter::create(&path, false).unwrap();
    writer.add(EncodedItem::new(&RgbImage::new(4, 4), None, None, PhotoFormat::Png).unwrap()).unwrap();
    writer.finish().unwrap();
    let dataset = Arc::new(Dataset::open(&path).unwrap());
    let error = Loader::new(Arc::clone(&dataset), &LoaderConfig::default()).err().unwrap().to_string();
    assert!(error.contains("images/00000.png") && error.contains("no mask"), "{error}");
    assert!(Cached::new(&dataset, &[4], &|_| {}).is_err());
}

#[test]
fn portraits_stream() {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/portraits/portraits_train.zip"));
    if !path.exists() {
        println!("skipped: {} is absent", path.display());
        return;
    }
    let dataset = Arc::new(Dataset::open(path).unwrap());
    let config = LoaderConfig { resolutions: vec![64, 128], batch: 32, ..LoaderConfig::default() };
    let start = std::time::Instant::now();
    let batches: Vec<_> = Loader::new(Arc::clone(&dataset), &config).unwrap().take(10).map(Result::unwrap).collect();
    println!("streamed at {:.0} images/s (64² and 128²)", 320.0 / start.elapsed().as_secs_f64());
    let sum = batches[3].at(64).unwrap().masks.sum(1).unwrap();
    assert!(values(&sum).iter().all(|sum| (sum - 1.0).abs() < 1e-5));
    let start = std::time::Instant::now();
    let cached = Cached::new(&dataset, &[64, 128], &|_| {}).unwrap();
    println!("cached {} portraits in {:.2} s", cached.len(), start.elapsed().as_secs_f64());
    assert_eq!(cached.len(), 902);
}
