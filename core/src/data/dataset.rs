//! Datasets: a folder or a zip of pictures, label maps and cameras, listed in `dataset.json`.
//!
//! Nothing is held in memory but the list: every item is read and decoded when it is asked for, from any thread.

mod files;
mod index;
mod writer;

use std::{
    collections::HashMap,
    path::{Path, PathBuf},
    sync::atomic::{AtomicUsize, Ordering},
};

use candle_core::Tensor;
use rayon::prelude::*;
use serde_json::{Map, Value};

use self::{files::Files, index::Index};
pub use self::{
    index::Entry,
    writer::{DatasetWriter, EncodedItem, PhotoFormat},
};
use super::{
    labels::{LabelMap, LabelScheme},
    picture::{self, RgbImage},
};
use crate::{
    camera::Camera,
    error::{Error, Result},
    model::file,
    region::REGION_COUNT,
};

const INDEX_NAME: &str = "dataset.json";
/// Largest `dataset.json` that is read, bytes: some millions of items.
const MAX_INDEX_BYTES: u64 = 1 << 30;
/// Largest file of an item, bytes.
const MAX_ITEM_BYTES: u64 = 64 << 20;

/// One decoded item.
#[derive(Clone, Debug)]
pub struct Item {
    /// The photo.
    pub image: RgbImage,
    /// Its regions, of the photo's size.
    pub mask: Option<LabelMap>,
    /// Where it was seen from.
    pub camera: Option<Camera>,
}

/// A dataset that can be read from several threads at once.
#[derive(Debug)]
pub struct Dataset {
    files: Files,
    path: PathBuf,
    entries: Vec<Entry>,
    scheme: LabelScheme,
    extra: Map<String, Value>,
}

impl Dataset {
    /// Opens a dataset folder or zip, in our form or StyleGAN's. Reads its list and no picture.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let files = Files::open(path)?;
        if !files.contains(INDEX_NAME) {
            let remedy = "make a dataset of these files with `cnerf dataset import`";
            return Err(Error::malformed(path, format!("holds no {INDEX_NAME}; {remedy}")));
        }
        let bytes = files.read(INDEX_NAME, MAX_INDEX_BYTES)?;
        let Index { entries, scheme, extra } = Index::parse(&bytes, &files.path_of(INDEX_NAME), &files)?;
        Ok(Self { files, path: path.to_owned(), entries, scheme, extra })
    }

    /// Where the dataset lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Number of items.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there is no item.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// The list of items.
    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Items by person, in order of first appearance: those with the same integer in the field `head` (as `cnerf synth
    /// --views` writes it) are views of one person, every other item is a person of its own.
    pub fn people(&self) -> Vec<Vec<usize>> {
        let mut people: Vec<Vec<usize>> = Vec::new();
        let mut known = HashMap::new();
        for (index, entry) in self.entries().iter().enumerate() {
            let person = match entry.extra.get("head").and_then(|head| head.as_u64()) {
                Some(head) => *known.entry(head).or_insert(people.len()),
                None => people.len(),
            };
            match people.get_mut(person) {
                Some(views) => views.push(index),
                None => people.push(vec![index]),
            }
        }
        people
    }

    /// Fields of `dataset.json` beside `labels`, `classes` and `items`.
    pub fn extra(&self) -> &Map<String, Value> {
        &self.extra
    }

    /// The entry at `index`.
    pub fn entry(&self, index: usize) -> Result<&Entry> {
        self.entries.get(index).ok_or_else(|| {
            Error::malformed(&self.path, format!("has no item {index}: it holds {}", self.entries.len()))
        })
    }

    /// The bytes of a file of the dataset by its name, e.g. one named by an extra field.
    pub fn file(&self, name: &str) -> Result<Vec<u8>> {
        self.files.read(name, MAX_ITEM_BYTES)
    }

    /// Reads and decodes the photo at `index`.
    pub fn image(&self, index: usize) -> Result<RgbImage> {
        let name = &self.entry(index)?.image;
        picture::decode(&self.file(name)?, &self.files.path_of(name))
    }

    /// Reads and decodes the label map at `index`, if it has one.
    pub fn mask(&self, index: usize) -> Result<Option<LabelMap>> {
        let decode = |name: &String| LabelMap::decode(&self.file(name)?, &self.scheme, &self.files.path_of(name));
        self.entry(index)?.mask.as_ref().map(decode).transpose()
    }

    /// The camera at `index`, if it has one; angles out of range are refused.
    pub fn camera(&self, index: usize) -> Result<Option<Camera>> {
        let entry = self.entry(index)?;
        if let Some(fault) = entry.camera.as_ref().and_then(index::camera_fault) {
            return Err(Error::malformed(self.files.path_of(&entry.image), format!("its camera's {fault}")));
        }
        Ok(entry.camera)
    }

    /// The depth that `cnerf synth --with depth` left beside the item at `index`, along the view axis in world units,
    /// `[S, S]`.
    pub fn depth(&self, index: usize) -> Result<Option<Tensor>> {
        let Some(name) = self.entry(index)?.extra.get("depth").and_then(|name| name.as_str()) else {
            return Ok(None);
        };
        let path = self.files.path_of(name);
        let (tensors, _) = file::parse_safetensors(&path, &self.file(name)?)?;
        let depth = tensors.get("depth").filter(|depth| depth.rank() == 2);
        depth.cloned().map(Some).ok_or_else(|| Error::malformed(&path, "holds no tensor `depth` [S, S]"))
    }

    /// Reads and decodes the item at `index`. The photo must be square and the label map of its size.
    pub fn item(&self, index: usize) -> Result<Item> {
        let camera = self.camera(index)?;
        let image = self.image(index)?;
        let entry = self.entry(index)?;
        let (width, height) = image.dimensions();
        if width != height {
            let reason = format!("{width}×{height} is not square; align the photos with `cnerf dataset align`");
            return Err(Error::malformed(self.files.path_of(&entry.image), reason));
        }
        let mask = self.mask(index)?;
        if let (Some(mask), Some(name)) = (&mask, &entry.mask)
            && (mask.width(), mask.height()) != (width, height)
        {
            let found = format!("{}×{}, but the photo has {width}×{height}", mask.width(), mask.height());
            return Err(Error::malformed(self.files.path_of(name), format!("{found}; make them the same size")));
        }
        Ok(Item { image, mask, camera })
    }

    /// Reads every item and tells what is wrong with which file. `progress` is called with the number of items
    /// done, from several threads.
    pub fn check(&self, progress: &(dyn Fn(usize) + Sync)) -> CheckReport {
        let done = AtomicUsize::new(0);
        let items: Vec<Result<(u32, Option<[u64; REGION_COUNT]>)>> = (0..self.len())
            .into_par_iter()
            .map(|index| {
                let found = self.item(index).map(|item| (item.image.width(), item.mask.map(|mask| mask.counts())));
                progress(done.fetch_add(1, Ordering::Relaxed) + 1);
                found
            })
            .collect();
        let mut report = CheckReport { items: self.len(), ..CheckReport::default() };
        let mut pixels = [0u64; REGION_COUNT];
        for (index, item) in items.into_iter().enumerate() {
            match item {
                Ok((side, counts)) => {
                    *report.resolutions.entry(side).or_default() += 1;
                    report.with_mask += usize::from(counts.is_some());
                    for (sum, count) in pixels.iter_mut().zip(counts.unwrap_or_default()) {
                        *sum += count;
                    }
                }
                Err(error) => report.problems.push(Problem { index, error }),
            }
        }
        let total = pixels.iter().sum::<u64>().max(1);
        report.region_share = pixels.map(|count| count as f64 / total as f64);
        report.with_camera = self.entries.iter().filter(|entry| entry.camera.is_some()).count();
        report.problems.extend(self.duplicates());
        report.problems.sort_by_key(|problem| problem.index);
        report
    }

    fn duplicates(&self) -> Vec<Problem> {
        let mut first: HashMap<&str, usize> = HashMap::new();
        let mut problems = Vec::new();
        for (index, entry) in self.entries.iter().enumerate() {
            for name in [Some(&entry.image), entry.mask.as_ref()].into_iter().flatten() {
                if let Some(earlier) = first.get(name.as_str()) {
                    let reason = format!("listed twice, as items {earlier} and {index}; remove one");
                    problems.push(Problem { index, error: Error::malformed(self.files.path_of(name), reason) });
                } else {
                    first.insert(name, index);
                }
            }
        }
        problems
    }
}

/// The cameras a `dataset.json` lists for its pictures, in our form or StyleGAN's; the pictures need not be there.
pub fn read_cameras(path: &Path) -> Result<Vec<(String, Camera)>> {
    let bytes = picture::read_file(path, MAX_INDEX_BYTES)?;
    let folder = Files::Folder(path.parent().unwrap_or(Path::new(".")).to_owned());
    let cameras = Index::parse(&bytes, path, &folder)?.entries.into_iter().filter_map(|entry| {
        let camera = entry.camera?;
        Some(match index::camera_fault(&camera) {
            Some(fault) => Err(Error::malformed(path, format!("`{}`: its camera's {fault}", entry.image))),
            None => Ok((entry.image, camera)),
        })
    });
    cameras.collect()
}

/// What [`Dataset::check`] found.
#[derive(Debug, Default)]
pub struct CheckReport {
    /// Items listed.
    pub items: usize,
    /// Items with a sound label map.
    pub with_mask: usize,
    /// Items with a camera.
    pub with_camera: usize,
    /// How many sound items have which width, pixels.
    pub resolutions: std::collections::BTreeMap<u32, usize>,
    /// Each region's share of all sound label maps' pixels.
    pub region_share: [f64; REGION_COUNT],
    /// Everything that is wrong, by item.
    pub problems: Vec<Problem>,
}

/// One thing that is wrong with a dataset.
#[derive(Debug)]
pub struct Problem {
    /// The item.
    pub index: usize,
    /// What is wrong; names the file.
    pub error: Error,
}

#[cfg(test)]
mod tests;
