//! Who is inverted, and what the data set knows of them that the inverter is not told.

use std::path::{Path, PathBuf};

use cnerf_core::{
    camera::Camera,
    data::{
        dataset::{Dataset, Item},
        labels::LabelMap,
        picture,
    },
    eval::warp::Raster,
    rng::Stream,
};
use image::RgbImage;

use super::{EvaluationOptions, Helpers};
use crate::{
    align,
    error::{Error, Result},
    photo::{PhotoOptions, Subject},
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x6576_616c;
/// Photos in a folder that is no data set are told by these.
const EXTENSIONS: [&str; 5] = ["png", "jpg", "jpeg", "webp", "bmp"];

/// Who is inverted: the people of a data set, each with all views there are, or the photos of a folder.
pub struct People {
    source: Source,
}

enum Source {
    /// Items of each person; the first is inverted.
    Dataset {
        dataset: Box<Dataset>,
        people: Vec<Vec<usize>>,
    },
    Photos(Vec<PathBuf>),
}

/// Another view of a person.
pub(super) struct OtherView {
    pub camera: Camera,
    pub image: RgbImage,
    pub labels: Option<LabelMap>,
}

/// One person: what is inverted, and what is known.
pub(super) struct Person {
    pub name: String,
    pub subject: Subject,
    pub camera: Option<Camera>,
    pub labels: Option<LabelMap>,
    /// Depth along the view axis, world units.
    pub depth: Option<Raster>,
    pub others: Vec<OtherView>,
}

impl People {
    /// The data set at `path`, else the photos in it; at most `count` people, drawn from `seed`.
    ///
    /// Items of a data set that share a field `head` (`cnerf synth --views`, `--turns`) are views of one person.
    ///
    /// # Errors
    /// If `path` is neither, or holds nobody.
    pub fn open(path: &Path, count: usize, seed: u64) -> Result<Self> {
        let mut random = Stream::new(seed, &[STREAM]);
        if path.is_dir() && !path.join("dataset.json").is_file() {
            let mut photos = list_photos(path)?;
            let order = random.permutation(photos.len());
            photos = order.into_iter().take(count).filter_map(|index| photos.get(index).cloned()).collect();
            if photos.is_empty() {
                let reason = "holds neither dataset.json nor photos (png, jpg, webp, bmp)";
                return Err(Error::malformed(path, reason));
            }
            return Ok(Self { source: Source::Photos(photos) });
        }
        let dataset = Dataset::open(path)?;
        let people = dataset.people();
        if people.is_empty() {
            return Err(Error::malformed(path, "holds no portraits"));
        }
        let order = random.permutation(people.len());
        let people = order.into_iter().take(count).filter_map(|index| people.get(index).cloned()).collect();
        Ok(Self { source: Source::Dataset { dataset: Box::new(dataset), people } })
    }

    /// Number of people.
    pub fn len(&self) -> usize {
        match &self.source {
            Source::Dataset { people, .. } => people.len(),
            Source::Photos(photos) => photos.len(),
        }
    }

    /// Whether there is nobody.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The name of a person's photo.
    pub fn name(&self, index: usize) -> String {
        match &self.source {
            Source::Photos(photos) => photos.get(index).map(|path| path.display().to_string()),
            Source::Dataset { dataset, people } => people
                .get(index)
                .and_then(|items| dataset.entries().get(*items.first()?))
                .map(|entry| entry.image.clone()),
        }
        .unwrap_or_default()
    }

    /// What is inverted of one person, at `side` x `side` pixels.
    ///
    /// # Errors
    /// If the photo cannot be used, or the data set does not know what `options` ask it for.
    pub fn subject(
        &self,
        index: usize,
        side: u32,
        helpers: Helpers<'_>,
        options: &EvaluationOptions,
    ) -> Result<Subject> {
        Ok(self.read(index, side, helpers, options)?.subject)
    }

    /// Reads one person at `side` x `side` pixels.
    pub(super) fn read(
        &self,
        index: usize,
        side: u32,
        Helpers { parser, near, .. }: Helpers<'_>,
        options: &EvaluationOptions,
    ) -> Result<Person> {
        let name = self.name(index);
        let (dataset, items) = match &self.source {
            Source::Photos(photos) => {
                let path = photos.get(index).ok_or_else(|| Error::config("--count", "beyond the photos there are"))?;
                let mut subject = Subject::read(path, &PhotoOptions::default(), parser, side)?;
                near.map_or(Ok(()), |near| subject.start_near(near))?;
                return Ok(Person { name, subject, camera: None, labels: None, depth: None, others: Vec::new() });
            }
            Source::Dataset { dataset, people } => {
                (dataset, people.get(index).ok_or_else(|| Error::config("--count", "beyond the people there are"))?)
            }
        };
        let (first, rest) = items.split_first().ok_or_else(|| Error::config("--data", "a person without photos"))?;
        let Item { image, mask, camera } = dataset.item(*first)?;
        let labels = mask.map(|mask| mask.resized(side, side)).transpose()?;
        let mut aligned = align::already_aligned(&image, side)?;
        let parsed = parser.map(|parser| aligned.parse(&image, parser)).transpose()?;
        if options.known_pose {
            aligned.camera = camera
                .ok_or_else(|| Error::config("--known-pose", format!("{name}: the data set names no camera for it")))?;
        }
        let regions = if options.known_masks { labels.clone() } else { parsed };
        if options.known_masks && regions.is_none() {
            return Err(Error::config("--known-masks", format!("{name}: the data set has no mask of it")));
        }
        let mut subject = Subject {
            source: name.clone(),
            aligned,
            labels: regions,
            start: None,
            parser_seconds: None,
            warnings: Vec::new(),
        };
        near.map_or(Ok(()), |near| subject.start_near(near))?;
        let other = |index: &usize| -> Result<Option<OtherView>> {
            let Item { image, mask, camera } = dataset.item(*index)?;
            let Some(camera) = camera else { return Ok(None) };
            let labels = mask.map(|mask| mask.resized(side, side)).transpose()?;
            Ok(Some(OtherView { camera, image: picture::resize(&image, side, side)?, labels }))
        };
        let others = rest.iter().filter_map(|index| other(index).transpose()).collect::<Result<_>>()?;
        let depth = dataset.depth(*first)?.map(|depth| Raster::from_tensor(&depth.unsqueeze(0)?.unsqueeze(0)?));
        let depth = depth.transpose()?;
        Ok(Person { name, subject, camera, labels, depth, others })
    }
}

fn list_photos(folder: &Path) -> Result<Vec<PathBuf>> {
    let failed = |error| cnerf_core::Error::io(folder, error);
    let mut photos = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let extension = path.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase());
        if path.is_file() && extension.is_some_and(|extension| EXTENSIONS.contains(&extension.as_str())) {
            photos.push(path);
        }
    }
    photos.sort();
    Ok(photos)
}
