//! Batches: which items each one holds, streamed from a dataset by several threads, or drawn from a small set that
//! is decoded once.
//!
//! What batch n holds is a function of the seed and n alone, so a run resumed at step n continues with the batches
//! it would have seen, at any number of threads.

use std::{
    collections::BTreeMap,
    sync::Arc,
    thread::{self, JoinHandle},
};

use candle_core::{Device, Tensor};
use crossbeam_channel::{Receiver, Sender, unbounded};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{dataset::Dataset, picture};
use crate::{
    camera::Camera,
    error::{Error, Result},
    region::REGION_COUNT,
    rng::Stream,
};

/// What a random draw decides; part of the draw's path.
const ORDER: u64 = 0x6f72_6465;
const MIRROR: u64 = 0x6d69_7272;

/// One place in a batch: an item, as stored or mirrored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Draw {
    /// The item's index in the dataset.
    pub index: usize,
    /// Whether it is mirrored left to right, camera and labels included.
    pub mirrored: bool,
}

/// The endless order of a set's items: every epoch a new permutation, each item mirrored or not by a draw of its own.
#[derive(Clone, Debug)]
pub struct Order {
    seed: u64,
    count: usize,
    mirror: bool,
    epoch: Option<(u64, Vec<usize>)>,
}

impl Order {
    /// The order of `count` items; with `mirror`, half of the draws are mirrored.
    pub fn new(seed: u64, count: usize, mirror: bool) -> Self {
        Self { seed, count, mirror, epoch: None }
    }

    /// The draws of batch `step`.
    pub fn batch(&mut self, step: u64, size: usize) -> Vec<Draw> {
        let first = step.saturating_mul(size as u64);
        (0..size as u64).map(|place| self.draw(first.saturating_add(place))).collect()
    }

    /// The draw at a place of the endless order.
    pub fn draw(&mut self, place: u64) -> Draw {
        let count = self.count.max(1) as u64;
        let (epoch, within) = (place / count, (place % count) as usize);
        if self.epoch.as_ref().is_none_or(|(current, _)| *current != epoch) {
            self.epoch = Some((epoch, Stream::new(self.seed, &[ORDER, epoch]).permutation(self.count)));
        }
        let index = self.epoch.as_ref().and_then(|(_, order)| order.get(within)).copied().unwrap_or_default();
        let mirrored = self.mirror && Stream::new(self.seed, &[MIRROR, place]).chance(0.5);
        Draw { index, mirrored }
    }
}

/// How a dataset is streamed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LoaderConfig {
    /// Widths and heights at which every item is delivered, pixels.
    pub resolutions: Vec<usize>,
    /// Items a batch.
    pub batch: usize,
    /// Whether half of the items are mirrored.
    pub mirror: bool,
    /// Threads that read and decode.
    pub workers: usize,
    /// Batches that are ready or on their way ahead of the one asked for.
    pub prefetch: usize,
    /// Seed of order and mirroring.
    pub seed: u64,
}

impl Default for LoaderConfig {
    fn default() -> Self {
        Self { resolutions: vec![64], batch: 16, mirror: true, workers: 2, prefetch: 4, seed: 0 }
    }
}

impl LoaderConfig {
    fn validate(&self) -> Result<()> {
        let refuse = |option: &str, reason: &str| Err(Error::config(format!("loader.{option}"), reason));
        if self.resolutions.is_empty() {
            return refuse("resolutions", "give at least one");
        }
        if self.resolutions.iter().any(|side| !(1..=picture::MAX_SIDE as usize).contains(side)) {
            return refuse("resolutions", "each must be between 1 and 8192 pixels");
        }
        if self.batch == 0 || self.workers == 0 || self.prefetch == 0 {
            return refuse("batch", "batch, workers and prefetch must be at least 1");
        }
        Ok(())
    }
}

/// Pictures and masks of a batch at one resolution r.
#[derive(Clone, Debug)]
pub struct Level {
    /// r, pixels.
    pub resolution: usize,
    /// `[B, 3, r, r]`, f32 in [-1, 1]; area averages of the photos (Lanczos where r is the larger).
    pub images: Tensor,
    /// `[B, 9, r, r]`, f32: each region's share of every pixel; the nine sum to 1.
    pub masks: Tensor,
}

/// A batch, on the CPU.
#[derive(Clone, Debug)]
pub struct Batch {
    /// The step it belongs to.
    pub step: u64,
    /// Which items it holds.
    pub draws: Vec<Draw>,
    /// Where they were seen from, mirrored with their item.
    pub cameras: Vec<Camera>,
    /// The pictures, in the order of the configured resolutions.
    pub levels: Vec<Level>,
}

impl Batch {
    /// The pictures at one of the configured resolutions.
    pub fn at(&self, resolution: usize) -> Result<&Level> {
        self.levels.iter().find(|level| level.resolution == resolution).ok_or_else(|| no_such_level(resolution))
    }
}

fn no_such_level(resolution: usize) -> Error {
    Error::config("loader.resolutions", format!("{resolution} pixels is not among the resolutions asked for"))
}

/// Streams batches for ever. Decoding runs ahead on its own threads; dropping the loader ends them.
pub struct Loader {
    requests: Option<Sender<u64>>,
    finished: Receiver<(u64, Result<Batch>)>,
    early: BTreeMap<u64, Result<Batch>>,
    next_step: u64,
    next_request: u64,
    workers: Vec<JoinHandle<()>>,
}

impl Loader {
    /// Streams `dataset` from batch 0. Every item needs a label map and a camera: the first without is named.
    pub fn new(dataset: Arc<Dataset>, config: &LoaderConfig) -> Result<Self> {
        Self::resume(dataset, config, 0)
    }

    /// Streams `dataset` from batch `step`, as a loader that has delivered `step` batches would go on.
    pub fn resume(dataset: Arc<Dataset>, config: &LoaderConfig, step: u64) -> Result<Self> {
        config.validate()?;
        check_complete(&dataset)?;
        let (requests, pending) = unbounded::<u64>();
        let (results, finished) = unbounded();
        let workers = (0..config.workers).map(|index| {
            let (dataset, config) = (Arc::clone(&dataset), config.clone());
            let (pending, results) = (pending.clone(), results.clone());
            let work = move || {
                let mut order = Order::new(config.seed, dataset.len(), config.mirror);
                for step in pending {
                    let draws = order.batch(step, config.batch);
                    let batch = assemble(&dataset, step, draws, &config.resolutions);
                    if results.send((step, batch)).is_err() {
                        return;
                    }
                }
            };
            thread::Builder::new().name(format!("loader {index}")).spawn(work)
        });
        let workers = workers.collect::<std::io::Result<_>>().map_err(|error| Error::io(dataset.path(), error))?;
        let mut loader = Self {
            requests: Some(requests),
            finished,
            early: BTreeMap::new(),
            next_step: step,
            next_request: step,
            workers,
        };
        for _ in 0..config.prefetch {
            loader.request();
        }
        Ok(loader)
    }

    fn request(&mut self) {
        if let Some(requests) = &self.requests
            && requests.send(self.next_request).is_ok()
        {
            self.next_request += 1;
        }
    }

    /// The next batch. An item that cannot be read is an error that names its file; the batch after it still comes.
    pub fn next_batch(&mut self) -> Result<Batch> {
        let step = self.next_step;
        let batch = loop {
            if let Some(batch) = self.early.remove(&step) {
                break batch;
            }
            match self.finished.recv() {
                Ok((finished, batch)) => self.early.insert(finished, batch),
                Err(_) => return Err(Error::config("loader", "the decoding threads ended early")),
            };
        };
        self.next_step += 1;
        self.request();
        batch
    }
}

impl Iterator for Loader {
    type Item = Result<Batch>;

    fn next(&mut self) -> Option<Self::Item> {
        Some(self.next_batch())
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.requests = None;
        for worker in self.workers.drain(..) {
            // A worker that panicked has nothing more to say.
            let _ended = worker.join();
        }
    }
}

fn check_complete(dataset: &Dataset) -> Result<()> {
    if dataset.is_empty() {
        return Err(Error::malformed(dataset.path(), "the dataset has no items"));
    }
    for entry in dataset.entries() {
        let missing = match (&entry.mask, &entry.camera) {
            (None, _) => "mask",
            (_, None) => "azimuth and elevation",
            _ => continue,
        };
        let reason = format!("item `{}` has no {missing}, which training needs", entry.image);
        return Err(Error::malformed(dataset.path(), reason));
    }
    Ok(())
}

/// Pixels of one item at one resolution: colours `[r, r, 3]` and shares `[9, r, r]`.
struct Scaled {
    colours: Vec<u8>,
    shares: Vec<f32>,
}

fn decode(dataset: &Dataset, index: usize, resolutions: &[usize]) -> Result<(Camera, Vec<Scaled>)> {
    let item = dataset.item(index)?;
    let missing = |what| Error::malformed(dataset.path(), format!("item {index} has no {what}"));
    let camera = item.camera.ok_or_else(|| missing("camera"))?;
    let mask = item.mask.ok_or_else(|| missing("mask"))?;
    let scale = |&side: &usize| {
        let side = side as u32;
        let colours = picture::resize(&item.image, side, side)?.into_raw();
        Ok(Scaled { colours, shares: mask.one_hot(side, side) })
    };
    Ok((camera, resolutions.iter().map(scale).collect::<Result<_>>()?))
}

fn assemble(dataset: &Dataset, step: u64, draws: Vec<Draw>, resolutions: &[usize]) -> Result<Batch> {
    let mut cameras = Vec::with_capacity(draws.len());
    let mut planes: Vec<_> = resolutions.iter().map(|&side| Planes::with_capacity(side, draws.len())).collect();
    for draw in &draws {
        let (camera, scaled) = decode(dataset, draw.index, resolutions)?;
        cameras.push(if draw.mirrored { camera.mirrored() } else { camera });
        for (planes, scaled) in planes.iter_mut().zip(&scaled) {
            planes.push(&scaled.colours, scaled.shares.iter().copied(), draw.mirrored);
        }
    }
    let levels = planes.into_iter().map(Planes::finish).collect::<Result<_>>()?;
    Ok(Batch { step, draws, cameras, levels })
}

/// A level under construction: planes appended item by item.
struct Planes {
    resolution: usize,
    count: usize,
    images: Vec<f32>,
    masks: Vec<f32>,
}

impl Planes {
    fn with_capacity(resolution: usize, count: usize) -> Self {
        let pixels = resolution * resolution;
        let (images, masks) =
            (Vec::with_capacity(count * 3 * pixels), Vec::with_capacity(count * REGION_COUNT * pixels));
        Self { resolution, count: 0, images, masks }
    }

    /// Appends an item: colours `[r, r, 3]`, shares in plane order `[9, r, r]`.
    fn push(&mut self, colours: &[u8], shares: impl Iterator<Item = f32>, mirrored: bool) {
        let (images, masks) = (self.images.len(), self.masks.len());
        for channel in 0..3 {
            self.images.extend(colours.iter().skip(channel).step_by(3).map(|&value| picture::signed(value)));
        }
        self.masks.extend(shares);
        if mirrored {
            let new_rows = self.images[images..].chunks_exact_mut(self.resolution);
            new_rows.chain(self.masks[masks..].chunks_exact_mut(self.resolution)).for_each(<[f32]>::reverse);
        }
        self.count += 1;
    }

    fn finish(self) -> Result<Level> {
        let Self { resolution, count, images, masks } = self;
        let images = Tensor::from_vec(images, (count, 3, resolution, resolution), &Device::Cpu)?;
        let masks = Tensor::from_vec(masks, (count, REGION_COUNT, resolution, resolution), &Device::Cpu)?;
        Ok(Level { resolution, images, masks })
    }
}

/// A small dataset decoded once at a few resolutions, 12 bytes a pixel; any pixel of any item can be looked up.
#[derive(Clone, Debug)]
pub struct Cached {
    cameras: Vec<Camera>,
    levels: Vec<CachedLevel>,
}

/// All items of a [`Cached`] set at one resolution r.
#[derive(Clone, Debug)]
pub struct CachedLevel {
    resolution: usize,
    /// `[N, r, r, 3]`.
    colours: Vec<u8>,
    /// `[N, r, r, 9]`, shares in units of 1/255.
    shares: Vec<u8>,
}

impl Cached {
    /// Decodes every item of `dataset` at `resolutions` (pixels), on all of rayon's threads. Every item needs a
    /// label map and a camera. `progress` is called with the number of items done, from several threads.
    pub fn new(dataset: &Dataset, resolutions: &[usize], progress: &(dyn Fn(usize) + Sync)) -> Result<Self> {
        check_complete(dataset)?;
        let config = LoaderConfig { resolutions: resolutions.to_vec(), ..LoaderConfig::default() };
        config.validate()?;
        let done = std::sync::atomic::AtomicUsize::new(0);
        let decoded = (0..dataset.len()).into_par_iter().map(|index| {
            let (camera, scaled) = decode(dataset, index, resolutions)?;
            let packed: Vec<_> = scaled.into_iter().map(|scaled| (scaled.colours, pack(&scaled.shares))).collect();
            progress(done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1);
            Ok((camera, packed))
        });
        let decoded = decoded.collect::<Result<Vec<_>>>()?;
        let mut levels: Vec<_> = resolutions
            .iter()
            .map(|&resolution| {
                let pixels = decoded.len() * resolution * resolution;
                let (colours, shares) = (Vec::with_capacity(3 * pixels), Vec::with_capacity(REGION_COUNT * pixels));
                CachedLevel { resolution, colours, shares }
            })
            .collect();
        let mut cameras = Vec::with_capacity(decoded.len());
        for (camera, packed) in decoded {
            cameras.push(camera);
            for (level, (colours, shares)) in levels.iter_mut().zip(packed) {
                level.colours.extend(colours);
                level.shares.extend(shares);
            }
        }
        Ok(Self { cameras, levels })
    }

    /// Number of items.
    pub fn len(&self) -> usize {
        self.cameras.len()
    }

    /// Whether there is no item; never true of a set made here.
    pub fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// The camera of a draw, mirrored with it.
    pub fn camera(&self, draw: Draw) -> Option<Camera> {
        let camera = self.cameras.get(draw.index)?;
        Some(if draw.mirrored { camera.mirrored() } else { *camera })
    }

    /// All items at one of the resolutions.
    pub fn level(&self, resolution: usize) -> Result<&CachedLevel> {
        self.levels.iter().find(|level| level.resolution == resolution).ok_or_else(|| no_such_level(resolution))
    }

    /// A batch as a [`Loader`] would deliver it, but for the masks' 8-bit rounding.
    pub fn batch(&self, step: u64, draws: &[Draw]) -> Result<Batch> {
        let absent = || Error::config("draws", format!("an item beyond the {} there are", self.len()));
        let cameras = draws.iter().map(|&draw| self.camera(draw).ok_or_else(absent)).collect::<Result<_>>()?;
        let levels = self.levels.iter().map(|level| level.gather(draws).ok_or_else(absent)?.finish());
        Ok(Batch { step, draws: draws.to_vec(), cameras, levels: levels.collect::<Result<_>>()? })
    }
}

impl CachedLevel {
    /// Width and height, pixels.
    pub fn resolution(&self) -> usize {
        self.resolution
    }

    /// Colour (sRGB bytes) and region shares (units of 1/255) of the pixel at column `x`, row `y` of a draw.
    pub fn pixel(&self, draw: Draw, x: usize, y: usize) -> Option<([u8; 3], [u8; REGION_COUNT])> {
        if x >= self.resolution || y >= self.resolution {
            return None;
        }
        let x = if draw.mirrored { self.resolution - 1 - x } else { x };
        let pixel = (draw.index * self.resolution + y) * self.resolution + x;
        let colour = self.colours.get(3 * pixel..3 * pixel + 3)?.try_into().ok()?;
        let shares = self.shares.get(REGION_COUNT * pixel..REGION_COUNT * (pixel + 1))?.try_into().ok()?;
        Some((colour, shares))
    }

    fn gather(&self, draws: &[Draw]) -> Option<Planes> {
        let pixels = self.resolution * self.resolution;
        let mut planes = Planes::with_capacity(self.resolution, draws.len());
        for draw in draws {
            let colours = self.colours.get(draw.index * 3 * pixels..(draw.index + 1) * 3 * pixels)?;
            let size = REGION_COUNT * pixels;
            let shares = self.shares.get(draw.index * size..(draw.index + 1) * size)?;
            let planar = (0..REGION_COUNT).flat_map(|region| shares.iter().skip(region).step_by(REGION_COUNT));
            planes.push(colours, planar.map(|&share| f32::from(share) / 255.0), draw.mirrored);
        }
        Some(planes)
    }
}

/// Shares `[9, r, r]` as `[r, r, 9]` in units of 1/255.
fn pack(shares: &[f32]) -> Vec<u8> {
    let pixels = shares.len() / REGION_COUNT;
    let share = |index: usize| shares.get((index % REGION_COUNT) * pixels + index / REGION_COUNT).copied();
    (0..pixels * REGION_COUNT).map(|index| (share(index).unwrap_or_default() * 255.0).round() as u8).collect()
}

#[cfg(test)]
mod tests {
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
                assert_eq!(
                    (found.step, &found.draws, &found.cameras),
                    (expected.step, &expected.draws, &expected.cameras)
                );
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
        let batches: Vec<_> =
            Loader::new(Arc::clone(&dataset), &config).unwrap().take(10).map(Result::unwrap).collect();
        println!("streamed at {:.0} images/s (64² and 128²)", 320.0 / start.elapsed().as_secs_f64());
        let sum = batches[3].at(64).unwrap().masks.sum(1).unwrap();
        assert!(values(&sum).iter().all(|sum| (sum - 1.0).abs() < 1e-5));
        let start = std::time::Instant::now();
        let cached = Cached::new(&dataset, &[64, 128], &|_| {}).unwrap();
        println!("cached {} portraits in {:.2} s", cached.len(), start.elapsed().as_secs_f64());
        assert_eq!(cached.len(), 902);
    }
}
