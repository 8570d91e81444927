//! Batches: which items each one holds, streamed from a dataset by several threads, or drawn from a small set that
//! is decoded once.
//!
//! What batch n holds is a function of the seed and n alone, so a run resumed at step n continues with the batches
//! it would have seen, at any number of threads.

mod cached;

use std::{
    collections::BTreeMap,
    sync::Arc,
    thread::{self, JoinHandle},
};

use candle_core::{Device, Tensor};
use crossbeam_channel::{Receiver, Sender, unbounded};
use serde::{Deserialize, Serialize};

pub use self::cached::{Cached, CachedLevel};
use super::{dataset::Dataset, picture};
use crate::{
    camera::Camera,
    error::{Error, Result},
    region::REGION_COUNT,
    rng::Stream,
    train::team::Share,
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
    /// The process among those that share every batch: its rows are delivered of a whole batch that is as many times
    /// larger.
    #[serde(skip)]
    pub share: Share,
}

impl Default for LoaderConfig {
    fn default() -> Self {
        let share = Share::default();
        Self { resolutions: vec![64], batch: 16, mirror: true, workers: 2, prefetch: 4, seed: 0, share }
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
                    let draws = config.share.pick(&order.batch(step, config.share.whole(config.batch)));
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

#[cfg(test)]
mod tests;
