//! A photo brought into the models' frame: read, its face found and aligned, its region masks if somebody knows them.

use std::{
    path::{Path, PathBuf},
    time::Instant,
};

use candle_core::Tensor;
use cnerf_core::{
    camera::Camera,
    data::{
        labels::{LabelMap, LabelScheme},
        picture,
    },
};
use image::{GrayImage, RgbImage};
use kornia_image::{Image, ImageError, ImageSize};
use kornia_imgproc::color::gray_from_rgb_u8;

use crate::{
    align::{self, Aligned, CropTransform},
    detect,
    error::{Error, Result},
    parser::RegionParser,
    start::NearStart,
};

/// Photos with fewer pixels on a side cannot hold a usable face.
pub const SMALLEST_SIDE: u32 = 64;
/// Largest label map read, bytes.
const LARGEST_MASK_FILE: u64 = 64 << 20;
/// A crop that lies beyond the photo by more than this share is worth a warning.
const MUCH_PADDING: f64 = 0.15;

/// How to look at a photo.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoOptions {
    /// Which face, largest first.
    pub face: usize,
    /// The photo is framed like the training portraits already: do not look for a face.
    pub aligned: bool,
    /// Azimuth and elevation of the camera, radians, in place of those read from the head pose.
    pub pose: Option<[f64; 2]>,
    /// A `cnerf-9` label map of the photo (of the photo itself, not of its crop).
    pub mask: Option<PathBuf>,
}

/// What is inverted: a square portrait, where it came from, and what is known of it.
#[derive(Clone, Debug)]
pub struct Subject {
    /// The photo's name.
    pub source: String,
    /// The crop, its place in the photo and the first camera.
    pub aligned: Aligned,
    /// Region of every pixel of the crop, if known, at a size of its own.
    pub labels: Option<LabelMap>,
    /// The noise `[1, D]` of a portrait that looks like this one, if a [`NearStart`] was asked.
    pub start: Option<Tensor>,
    /// How long the parser took, seconds, if it was asked.
    pub parser_seconds: Option<f64>,
    /// What the user should know, e.g. that there were several faces.
    pub warnings: Vec<String>,
}

impl Subject {
    /// Reads and aligns a photo at `size` x `size` pixels. Regions come from the label map in `options`, else from
    /// `parser`, else are unknown.
    ///
    /// Errors: the photo or the label map cannot be used; see [`detect::choose`] for faces that are refused.
    pub fn read(path: &Path, options: &PhotoOptions, parser: Option<&dyn RegionParser>, size: u32) -> Result<Self> {
        let photo = read(path)?;
        let mut warnings = Vec::new();
        let mut aligned = if options.aligned {
            if photo.width() != photo.height() {
                warnings.push(format!("{}: not square; its centre is taken", path.display()));
            }
            align::already_aligned(&photo, size)?
        } else {
            let (face, found) = detect::choose(path, &photo, options.face)?;
            if found.len() > 1 {
                let (count, taken) = (found.len(), options.face);
                let list = detect::list(&found);
                warnings.push(format!("{}: {count} faces, number {taken} is taken ({list})", path.display()));
            }
            align::align(&photo, &face, size)?
        };
        if aligned.padded > MUCH_PADDING {
            let percent = 100.0 * aligned.padded;
            warnings.push(format!("{}: {percent:.0} % of the crop lies beyond the photo, mirrored", path.display()));
        }
        let began = Instant::now();
        let parsed = parser.map(|parser| aligned.parse(&photo, parser)).transpose()?;
        let parser_seconds = parsed.as_ref().map(|_| began.elapsed().as_secs_f64());
        if let Some([azimuth, elevation]) = options.pose {
            aligned.camera = Camera { roll_rad: aligned.camera.roll_rad, ..Camera::at(azimuth, elevation) };
        }
        let labels = match &options.mask {
            Some(mask) => Some(read_labels(mask, &photo, &aligned.transform, size)?),
            None => parsed,
        };
        Ok(Self { source: path.display().to_string(), aligned, labels, start: None, parser_seconds, warnings })
    }

    /// Asks `near` for a start; it has none for a portrait whose regions are unknown.
    pub fn start_near(&mut self, near: &NearStart) -> Result<()> {
        self.start = self.labels.as_ref().map(|labels| near.noise(&self.aligned.picture, labels)).transpose()?;
        Ok(())
    }
}

/// Reads a photo upright; see [`picture::read`]. Refuses one with fewer than [`SMALLEST_SIDE`] pixels on a side.
pub fn read(path: &Path) -> Result<RgbImage> {
    let photo = picture::read(path)?;
    let (width, height) = photo.dimensions();
    if width.min(height) < SMALLEST_SIDE {
        return Err(Error::PhotoTooSmall { path: path.to_owned(), width, height, least: SMALLEST_SIDE });
    }
    Ok(photo)
}

/// ITU-R BT.601 luma, as the detector was trained on.
pub fn luma(photo: &RgbImage) -> Result<GrayImage> {
    let size = ImageSize { width: photo.width() as usize, height: photo.height() as usize };
    let convert = || -> Result<Vec<u8>, ImageError> {
        let mut grey = Image::<u8, 1>::from_size_val(size, 0)?;
        gray_from_rgb_u8(&Image::<u8, 3>::new(size, photo.as_raw().clone())?, &mut grey)?;
        Ok(grey.into_vec())
    };
    let values = convert().map_err(|error| Error::malformed("the photo's luma", error))?;
    GrayImage::from_raw(photo.width(), photo.height(), values)
        .ok_or_else(|| Error::malformed("the photo's luma", "has another size than the photo"))
}

/// A photo's label map cut as the photo is: the nearest label, mirrored beyond the edges. A map of another size than
/// the photo's is stretched over it, if its proportions are the photo's.
fn read_labels(path: &Path, photo: &RgbImage, transform: &CropTransform, size: u32) -> Result<LabelMap> {
    let labels = LabelMap::decode(&picture::read_file(path, LARGEST_MASK_FILE)?, &LabelScheme::cnerf(), path)?;
    let (width, height) = (f64::from(labels.width()), f64::from(labels.height()));
    let scale = width / f64::from(photo.width());
    if (height - scale * f64::from(photo.height())).abs() > 1.0 {
        let (photo_width, photo_height) = photo.dimensions();
        let reason = format!("{width}x{height} pixels, but the photo has {photo_width}x{photo_height}");
        return Err(Error::malformed(path, reason));
    }
    let cut = (0..size * size).map(|index| {
        let at = |step: u32| f64::from(2 * step + 1) / f64::from(size) - 1.0;
        let (x, y) = transform.photo_point(at(index % size), at(index / size));
        let column = align::mirrored((x * scale).floor() as i64, labels.width());
        let row = align::mirrored((y * scale).floor() as i64, labels.height());
        labels.labels().get((row * labels.width() + column) as usize).copied().unwrap_or(0)
    });
    Ok(LabelMap::new(size, size, cut.collect())?)
}

#[cfg(test)]
mod tests {
    use super::*;

    const ASTRONAUT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/photos/astronaut.png");

    #[test]
    fn refusals_name_the_file_and_the_fault() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("broken.png");
        assert!(matches!(read(&path), Err(Error::Core(cnerf_core::Error::Io { .. }))));
        std::fs::write(&path, b"\x89PNG\r\n\x1a\nnot a picture").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("broken.png"));
        RgbImage::new(300, 20).save(&path).unwrap();
        assert!(matches!(read(&path), Err(Error::PhotoTooSmall { width: 300, height: 20, .. })));
    }

    #[test]
    fn luma_is_bt_601s() {
        let photo = RgbImage::from_fn(7, 5, |x, y| image::Rgb([(x * 40) as u8, (y * 60) as u8, (x * y * 10) as u8]));
        for (pixel, grey) in photo.pixels().zip(luma(&photo).unwrap().pixels()) {
            let [red, green, blue] = pixel.0.map(f64::from);
            let exact = 0.299 * red + 0.587 * green + 0.114 * blue;
            // Half a level of rounding and a little of the weights' own.
            assert!((exact - f64::from(grey.0[0])).abs() < 0.52, "{pixel:?} {grey:?}");
        }
    }

    #[test]
    fn label_maps_are_cut_as_the_photo_is() {
        use image::Luma;
        let folder = tempfile::tempdir().unwrap();
        let mask = folder.path().join("mask.png");
        // Region 5 in the square around her nose at (225, 125), in a map of half the photo's size.
        let map = GrayImage::from_fn(256, 256, |x, y| {
            Luma([if (107..119).contains(&x) && (57..69).contains(&y) { 5 } else { 0 }])
        });
        map.save(&mask).unwrap();
        let options = PhotoOptions { mask: Some(mask.clone()), pose: Some([0.1, -0.2]), ..PhotoOptions::default() };
        let subject = Subject::read(Path::new(ASTRONAUT), &options, None, 128).unwrap();
        let labels = subject.labels.unwrap();
        let nose: Vec<usize> = (0..128 * 128).filter(|index| labels.labels()[*index] == 5).collect();
        let mean = |of: fn(usize) -> usize| nose.iter().map(|index| of(*index) as f64).sum::<f64>() / nose.len() as f64;
        assert!((mean(|index| index % 128) - 64.0).abs() < 6.0 && (mean(|index| index / 128) - 76.0).abs() < 8.0);
        assert_eq!((subject.aligned.camera.azimuth_rad, subject.aligned.camera.elevation_rad), (0.1, -0.2));
        assert!(subject.warnings.is_empty());

        GrayImage::new(100, 256).save(&mask).unwrap();
        let error = Subject::read(Path::new(ASTRONAUT), &options, None, 128).unwrap_err().to_string();
        assert!(error.contains("mask.png") && error.contains("512x512"), "{error}");
    }
}
