//! Other projects' photos and masks, read into a dataset of ours: CelebAMask-HQ's folders of part masks, photos with
//! a folder of label maps (FFHQ, CelebAMask-HQ's 19-class maps), and the `%05d.npy` masks of the paper's authors.

mod npy;

use std::{
    collections::{BTreeMap, HashMap},
    fs,
    path::{Path, PathBuf},
};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::npy::Array;
use super::{
    dataset::{DatasetWriter, EncodedItem, PhotoFormat, read_cameras},
    labels::{CELEBAMASK_HQ_CLASSES, LabelMap, LabelScheme, class_region},
    picture,
};
use crate::{
    camera::Camera,
    error::{Error, Result},
    region::{REGION_COUNT, Region},
};

/// Files read and encoded at a time, before they are written in order.
const CHUNK: usize = 64;
/// Deepest folder that is searched.
const MAX_DEPTH: usize = 8;

/// How masks are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "kebab-case")]
pub enum MaskFormat {
    /// One picture a class, `00000_l_eye.png`, as in `CelebAMask-HQ-mask-anno`
    CelebamaskParts,
    /// Label maps with CelebAMask-HQ's 19 classes, in its order unless --classes gives another
    #[serde(rename = "celebamask-hq-19")]
    #[cfg_attr(feature = "clap", value(name = "celebamask-hq-19"))]
    CelebamaskHq19,
    /// Label maps with this program's nine regions, or with the classes of --classes
    #[serde(rename = "cnerf-9")]
    #[cfg_attr(feature = "clap", value(name = "cnerf-9"))]
    Cnerf9,
    /// `.npy` arrays of the paper's authors: nine masks, or one label map, with their order of channels
    AuthorsNpy,
}

/// What to import, and how.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
#[serde(deny_unknown_fields)]
pub struct ImportConfig {
    /// Folder of photos, searched with its subfolders; square and aligned alike
    #[cfg_attr(feature = "clap", arg(long, value_name = "DIR"))]
    pub images: PathBuf,
    /// Folder of masks, searched with its subfolders; a mask and its photo have one number or one name
    #[cfg_attr(feature = "clap", arg(long, value_name = "DIR"))]
    pub masks: PathBuf,
    /// How the masks are stored
    #[cfg_attr(feature = "clap", arg(long, value_enum))]
    pub format: MaskFormat,
    /// Names of the label maps' classes in the order of their values, where it is not the format's own
    #[cfg_attr(feature = "clap", arg(long, value_delimiter = ',', value_name = "NAMES"))]
    #[serde(default)]
    pub classes: Vec<String>,
    /// A dataset.json (this program's or StyleGAN's) with the photos' cameras
    #[cfg_attr(feature = "clap", arg(long, value_name = "FILE"))]
    #[serde(default)]
    pub cameras: Option<PathBuf>,
    /// Width and height of the imported pictures; the masks' own if not given
    #[cfg_attr(feature = "clap", arg(long, value_name = "PIXELS"))]
    #[serde(default)]
    pub resolution: Option<u32>,
    /// Store photos as JPEG of this quality (1 to 100) in place of PNG
    #[cfg_attr(feature = "clap", arg(long, value_name = "QUALITY"))]
    #[serde(default)]
    pub jpeg: Option<u8>,
}

/// What an import did.
#[derive(Debug, Default)]
pub struct ImportReport {
    /// Items written.
    pub written: usize,
    /// Photos left out, and why; each names its file.
    pub failed: Vec<Error>,
}

/// A photo and the files its regions come from.
struct Source {
    image: PathBuf,
    masks: Vec<PathBuf>,
    camera: Option<Camera>,
}

/// Imports photos and masks into `writer`, which the caller finishes. Photos whose files are missing or bad are left
/// out and reported; an error is returned if none is left. `progress` is called with the number of photos done and
/// their total.
pub fn import(
    config: &ImportConfig,
    writer: &mut DatasetWriter,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<ImportReport> {
    let scheme = scheme(config)?;
    let (sources, failed) = find(config)?;
    let mut report = ImportReport { written: 0, failed };
    for (done, chunk) in sources.chunks(CHUNK).enumerate() {
        let items: Vec<Result<EncodedItem>> = chunk.par_iter().map(|source| convert(source, config, &scheme)).collect();
        for item in items {
            match item {
                Ok(item) => {
                    writer.add(item)?;
                    report.written += 1;
                }
                Err(error) => report.failed.push(error),
            }
        }
        progress((done * CHUNK + chunk.len()).min(sources.len()), sources.len());
    }
    if report.written == 0 {
        return Err(report.failed.into_iter().next().unwrap_or_else(|| {
            Error::malformed(&config.images, "holds no PNG, JPEG, WebP or BMP photo; give the folder of photos")
        }));
    }
    Ok(report)
}

fn scheme(config: &ImportConfig) -> Result<LabelScheme> {
    let named = !config.classes.is_empty();
    match config.format {
        MaskFormat::CelebamaskParts | MaskFormat::AuthorsNpy if named => {
            Err(Error::config("classes", "only label maps take class names; leave it out"))
        }
        _ if named => LabelScheme::from_class_names(&config.classes),
        MaskFormat::CelebamaskHq19 => Ok(LabelScheme::celebamask_hq()),
        _ => Ok(LabelScheme::cnerf()),
    }
}

/// Pairs photos with their masks and cameras, in the order of their keys.
fn find(config: &ImportConfig) -> Result<(Vec<Source>, Vec<Error>)> {
    let photos = files_below(&config.images, &["png", "jpg", "jpeg", "webp", "bmp"])?;
    let extension = if config.format == MaskFormat::AuthorsNpy { "npy" } else { "png" };
    let mut masks: HashMap<Key, Vec<PathBuf>> = HashMap::new();
    for path in files_below(&config.masks, &[extension])? {
        let stem = stem(&path);
        let stem = match config.format {
            MaskFormat::CelebamaskParts => stem.split_once('_').map_or(stem, |(number, _)| number),
            _ => stem,
        };
        masks.entry(Key::of(stem)).or_default().push(path);
    }
    let cameras: HashMap<Key, Camera> = match &config.cameras {
        Some(path) => {
            read_cameras(path)?.into_iter().map(|(name, camera)| (Key::of(stem(Path::new(&name))), camera)).collect()
        }
        None => HashMap::new(),
    };

    let mut keyed: BTreeMap<Key, PathBuf> = BTreeMap::new();
    let mut failed = Vec::new();
    for path in photos {
        // The masks may lie below the folder of photos.
        if path.starts_with(&config.masks) && config.masks != config.images {
            continue;
        }
        match keyed.entry(Key::of(stem(&path))) {
            std::collections::btree_map::Entry::Vacant(place) => {
                place.insert(path);
            }
            std::collections::btree_map::Entry::Occupied(first) => {
                let reason = format!("has the number or name of {}; rename one", first.get().display());
                failed.push(Error::malformed(path, reason));
            }
        }
    }
    let mut sources = Vec::new();
    for (key, image) in keyed {
        let Some(masks) = masks.remove(&key) else {
            let reason = format!("no mask of this number or name below {}", config.masks.display());
            failed.push(Error::malformed(image, reason));
            continue;
        };
        if config.format != MaskFormat::CelebamaskParts
            && let [first, second, ..] = masks.as_slice()
        {
            let reason = format!("two masks: {} and {}; remove one", first.display(), second.display());
            failed.push(Error::malformed(image, reason));
            continue;
        }
        if let Some(path) = &config.cameras
            && !cameras.contains_key(&key)
        {
            failed.push(Error::malformed(image, format!("no camera of this number or name in {}", path.display())));
            continue;
        }
        sources.push(Source { image, masks, camera: cameras.get(&key).copied() });
    }
    Ok((sources, failed))
}

/// What pairs a photo with its masks: `0.jpg`, `00000.png` and EG3D's `img00000000.png` are all number 0.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
enum Key {
    Number(u64),
    Name(String),
}

impl Key {
    fn of(stem: &str) -> Self {
        let digits = stem.strip_prefix("img").unwrap_or(stem);
        let number = digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok()).flatten();
        number.map_or_else(|| Self::Name(stem.to_owned()), Self::Number)
    }
}

fn stem(path: &Path) -> &str {
    path.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default()
}

/// Files with one of `extensions` below a folder, sorted by path.
fn files_below(folder: &Path, extensions: &[&str]) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let mut pending = vec![(folder.to_owned(), 0)];
    while let Some((folder, depth)) = pending.pop() {
        for entry in fs::read_dir(&folder).map_err(|error| Error::io(&folder, error))? {
            let path = entry.map_err(|error| Error::io(&folder, error))?.path();
            if path.is_dir() {
                if depth < MAX_DEPTH {
                    pending.push((path, depth + 1));
                }
            } else if let Some(extension) = path.extension().and_then(|extension| extension.to_str())
                && extensions.contains(&extension.to_lowercase().as_str())
            {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}

fn convert(source: &Source, config: &ImportConfig, scheme: &LabelScheme) -> Result<EncodedItem> {
    let image = picture::read(&source.image)?;
    if image.width() != image.height() {
        let reason = format!("{}×{} is not square; align it with `cnerf dataset align`", image.width(), image.height());
        return Err(Error::malformed(&source.image, reason));
    }
    let mask = match (config.format, source.masks.as_slice()) {
        (MaskFormat::CelebamaskParts, parts) => assemble_parts(parts)?,
        (_, []) => return Err(Error::malformed(&source.image, "has no mask")),
        (MaskFormat::AuthorsNpy, [path, ..]) => authors_mask(path)?,
        (_, [path, ..]) => LabelMap::decode(&picture::read_file(path, picture::MAX_FILE_BYTES)?, scheme, path)?,
    };
    if mask.width() != mask.height() {
        let shown = source.masks.first().unwrap_or(&source.image);
        let reason = format!("{}×{} is not square, but its photo is", mask.width(), mask.height());
        return Err(Error::malformed(shown, reason));
    }
    let side = config.resolution.unwrap_or(mask.width());
    let image = picture::resize(&image, side, side)?;
    let mask = mask.resized(side, side)?;
    let format = config.jpeg.map_or(PhotoFormat::Png, PhotoFormat::Jpeg);
    let name = source.image.strip_prefix(&config.images).unwrap_or(&source.image).to_string_lossy().into_owned();
    Ok(EncodedItem::new(&image, Some(&mask), source.camera, format)?.with("source", name))
}

/// Lays CelebAMask-HQ's part masks over each other in the order of its classes, as its authors do.
fn assemble_parts(paths: &[PathBuf]) -> Result<LabelMap> {
    let class = |path: &Path| stem(path).split_once('_').map(|(_, class)| class.to_owned()).unwrap_or_default();
    let spelling = |class: &str| match class {
        "eye_g" => "glasses".to_owned(),
        "ear_r" => "earring".to_owned(),
        "neck_l" => "necklace".to_owned(),
        class => class.to_owned(),
    };
    let mut parts: Vec<(usize, Region, &PathBuf)> = Vec::new();
    for path in paths {
        let class = class(path);
        let unknown = || Error::malformed(path, format!("`{class}` is not a class of CelebAMask-HQ; remove the file"));
        let place = CELEBAMASK_HQ_CLASSES.iter().position(|known| *known == spelling(&class)).ok_or_else(unknown)?;
        parts.push((place, class_region(&class).ok_or_else(unknown)?, path));
    }
    parts.sort();
    let mut size = None;
    let mut labels: Vec<u8> = Vec::new();
    for (_, region, path) in parts {
        let part = picture::read(path)?;
        let (width, height) = *size.get_or_insert(part.dimensions());
        if part.dimensions() != (width, height) {
            let found = format!("{}×{}", part.width(), part.height());
            return Err(Error::malformed(path, format!("{found}, but other parts have {width}×{height}")));
        }
        labels.resize(width as usize * height as usize, Region::Background as u8);
        for (label, pixel) in labels.iter_mut().zip(part.pixels()) {
            if pixel.0[0] > 127 {
                *label = region as u8;
            }
        }
    }
    let (width, height) = size.unwrap_or_default();
    LabelMap::new(width, height, labels)
}

/// The authors' channels: as ours, but mouth before eyebrows (reference notes, 4).
const AUTHORS_CHANNELS: [Region; REGION_COUNT] = [
    Region::Background,
    Region::Face,
    Region::Eyes,
    Region::Mouth,
    Region::Eyebrows,
    Region::Nose,
    Region::Ears,
    Region::Hair,
    Region::Neck,
];

/// Which region shows where the authors' dilated masks overlap: small ones over those they lie on.
const FRONT_TO_BACK: [Region; REGION_COUNT] = [
    Region::Eyes,
    Region::Eyebrows,
    Region::Mouth,
    Region::Nose,
    Region::Ears,
    Region::Hair,
    Region::Face,
    Region::Neck,
    Region::Background,
];

/// A mask of the authors: `[9, H, W]`, a pixel belonging to a channel where that is 0.5 or more, or labels `[H, W]`.
fn authors_mask(path: &Path) -> Result<LabelMap> {
    let array = Array::parse(&picture::read_file(path, picture::MAX_FILE_BYTES)?, path)?;
    let side = 1..=picture::MAX_SIDE as usize;
    let (height, width) = match *array.shape {
        [REGION_COUNT, height, width] | [height, width] if side.contains(&height) && side.contains(&width) => {
            (height, width)
        }
        _ => {
            let reason = format!("shape {:?}; masks have shape [9, H, W] or [H, W]", array.shape);
            return Err(Error::malformed(path, reason));
        }
    };
    let pixels = height * width;
    let mut labels = vec![Region::Background as u8; pixels];
    if array.shape.len() == 2 {
        for (label, &value) in labels.iter_mut().zip(&array.values) {
            let region = AUTHORS_CHANNELS.iter().zip(0u8..).find(|(_, channel)| f64::from(*channel) == value);
            let (region, _) = region.ok_or_else(|| Error::malformed(path, format!("label {value} is not 0 to 8")))?;
            *label = *region as u8;
        }
    } else {
        for region in FRONT_TO_BACK.into_iter().rev() {
            let channel = AUTHORS_CHANNELS.iter().position(|known| *known == region).unwrap_or_default();
            for (label, &value) in labels.iter_mut().zip(array.values.iter().skip(channel * pixels)) {
                if value >= 0.5 {
                    *label = region as u8;
                }
            }
        }
    }
    LabelMap::new(width as u32, height as u32, labels)
}

#[cfg(test)]
mod tests;
