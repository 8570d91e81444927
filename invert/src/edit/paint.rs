//! A repainted region map drives the shapes: the user moves the hairline on the map, the hair's shape code follows.

use std::path::Path;

use candle_core::{DType, Tensor};
use cnerf_core::{
    camera::Camera,
    codes::Aspect,
    data::{
        labels::{LabelMap, LabelScheme},
        picture,
    },
    region::{REGION_COUNT, Region, RegionSet},
    rng::Stream,
};

use super::displacement::Displacement;
use crate::{
    error::{Error, Result},
    inverter::Opened,
    objective::{self, Level, PhotoWeights},
    space::CodeSpace,
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x7061_696e;
const STEPS: usize = 120;
/// Rays of a step; half of them where the map was repainted.
const RAYS: usize = 1024;
const RATE: f64 = 0.06;
/// Holds the codes near where they were: without it, regions change where the map says nothing of them.
const HOLD: f64 = 4e-3;
/// A region takes part if the map changed it by more than this share of the picture.
const LEAST_SHARE: f64 = 5e-4;
const WEIGHTS: PhotoWeights = PhotoWeights { absolute: 1.0, squared: 0.0, perceptual: 0.0, masks: 2.0, opacity: 0.1 };

/// Largest map read, bytes.
const LARGEST_FILE: u64 = 64 << 20;
/// How far a channel may be from a region's colour: editors round when they convert colours.
const COLOUR_TOLERANCE: u8 = 6;

/// Reads a repainted map: a label map of `cnerf-9`, or a picture in the regions' colours, as
/// [`LabelMap::colours`] paints them.
///
/// # Errors
/// [`Error::Core`] naming the file: no PNG, not square, or a colour that is no region's.
pub fn read_map(path: &Path) -> Result<LabelMap> {
    let bytes = picture::read_file(path, LARGEST_FILE)?;
    let map = match LabelMap::decode(&bytes, &LabelScheme::cnerf(), path) {
        Ok(map) => map,
        Err(as_labels) => {
            let painted = picture::decode(&bytes, path)?;
            let grey = painted.pixels().all(|pixel| pixel.0[0] == pixel.0[1] && pixel.0[1] == pixel.0[2]);
            if grey {
                return Err(as_labels.into());
            }
            let labels = painted.enumerate_pixels().map(|(x, y, pixel)| {
                region_of(pixel.0).map(|region| region as u8).ok_or_else(|| {
                    let [red, green, blue] = pixel.0;
                    let colour = format!("#{red:02x}{green:02x}{blue:02x} at ({x}, {y})");
                    let remedy = "paint with the colours of the map, without smoothing, and save as PNG";
                    Error::malformed(path, format!("{colour} is no region's colour; {remedy}"))
                })
            });
            LabelMap::new(painted.width(), painted.height(), labels.collect::<Result<_>>()?)?
        }
    };
    if map.width() != map.height() {
        let reason = format!("{}x{} pixels; a portrait's map is square", map.width(), map.height());
        return Err(Error::malformed(path, reason));
    }
    Ok(map)
}

fn region_of(colour: [u8; 3]) -> Option<Region> {
    Region::ALL
        .into_iter()
        .find(|region| region.colour().iter().zip(colour).all(|(own, found)| own.abs_diff(found) <= COLOUR_TOLERANCE))
}

/// The regions that `painted` gives another extent than `shown` (of the same size), without the background: it is
/// what is left.
pub fn repainted(shown: &LabelMap, painted: &LabelMap) -> RegionSet {
    let mut changed = [0usize; REGION_COUNT];
    for (old, new) in shown.labels().iter().zip(painted.labels()).filter(|(old, new)| old != new) {
        for label in [old, new] {
            if let Some(count) = changed.get_mut(usize::from(*label)) {
                *count += 1;
            }
        }
    }
    let least = (LEAST_SHARE * shown.labels().len() as f64).max(1.0);
    let moved = |region: &Region| changed.get(region.index()).is_some_and(|count| *count as f64 >= least);
    Region::ALL.into_iter().skip(1).filter(moved).fold(RegionSet::EMPTY, |set, region| set.union(region.into()))
}

/// Codes `[1, 9, 2, D]` near the portrait's whose region map from `camera` is `painted`. Only shape rows of `regions`
/// move. Colours are held where the map did not change.
///
/// # Errors
/// [`Error::Core`] if the map changes none of `regions`.
pub fn codes(opened: &Opened, camera: &Camera, painted: &LabelMap, regions: RegionSet) -> Result<Tensor> {
    let device = opened.generator.device();
    let resolution = opened.generator.render_resolution();
    let side = resolution as u32;
    let picture = opened.picture(camera)?;
    let shown = LabelMap::from_masks(&picture.frame.masks.squeeze(0)?)?;
    let wanted = painted.resized(side, side)?;
    let differs: Vec<f32> =
        shown.labels().iter().zip(wanted.labels()).map(|(old, new)| f32::from(u8::from(old != new))).collect();
    if differs.iter().all(|differs| *differs == 0.0) {
        return Err(Error::config("--mask-paint", "the map is the portrait's own; repaint some of it"));
    }
    let shape = (1, REGION_COUNT, resolution, resolution);
    let kept = Tensor::from_vec(
        differs.iter().map(|differs| 1.0 - differs).collect(),
        (1, 1, resolution, resolution),
        &device,
    )?;
    let level = Level {
        resolution,
        colour: picture.frame.colour.detach(),
        weight: kept,
        masks: Some(Tensor::from_vec(painted.one_hot(side, side), shape, &device)?),
    };
    let focus: Vec<u32> =
        differs.iter().enumerate().filter(|(_, differs)| **differs > 0.0).map(|(index, _)| index as u32).collect();

    let space = CodeSpace::measure(&opened.generator)?;
    let mut search = Displacement::new(&opened.codes, space, regions, Aspect::Shape, STEPS, RATE)?;
    let sampling = opened.generator.render_settings().sampling;
    let view = Camera::parameter_tensor(&[*camera], &device)?;
    for step in 0..STEPS {
        let mut random = Stream::new(0, &[STREAM, step as u64]);
        let pixels = draw(resolution, &focus, &mut random, &device)?;
        let field = opened.generator.field().portraits(&search.live()?)?;
        let output = objective::render_pixels(&field, &view, &pixels, resolution, &sampling, &mut random)?;
        let loss = objective::ray_loss(&output, &level, &pixels, &WEIGHTS)?.total;
        search.descend(&(loss + (search.distance()? * HOLD)?)?, "the painted map's loss")?;
    }
    search.codes()
}

/// Half the rays where the map changed, half anywhere; u32 indices.
fn draw(resolution: usize, focus: &[u32], random: &mut Stream, device: &candle_core::Device) -> Result<Tensor> {
    let anywhere: Vec<u32> = objective::draw_pixels(resolution, RAYS / 2, random, device)?.to_vec1()?;
    let there =
        random.permutation(focus.len()).into_iter().take(RAYS / 2).filter_map(|index| focus.get(index).copied());
    let chosen: Vec<u32> = there.chain(anywhere).collect();
    let length = chosen.len();
    Ok(Tensor::from_vec(chosen, length, device)?.to_dtype(DType::U32)?)
}

#[cfg(test)]
mod tests {
    use image::{GrayImage, Luma, Rgb, RgbImage};

    use super::*;

    #[test]
    fn maps_are_read_as_labels_or_as_colours() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.png");
        let labels: Vec<u8> = (0..64).map(|index| (index % 9) as u8).collect();
        let map = LabelMap::new(8, 8, labels).unwrap();
        std::fs::write(&path, map.encode().unwrap()).unwrap();
        assert_eq!(read_map(&path).unwrap(), map);
        map.colours().save(&path).unwrap();
        assert_eq!(read_map(&path).unwrap(), map);

        let refused = |said: &str| {
            let error = read_map(&path).unwrap_err().to_string();
            assert!(error.contains("map.png") && error.contains(said), "{error}");
        };
        RgbImage::from_pixel(8, 8, Rgb([255, 0, 255])).save(&path).unwrap();
        refused("#ff00ff at (0, 0)");
        GrayImage::from_pixel(8, 8, Luma([200])).save(&path).unwrap();
        refused("label 200");
        map.colours().save(&path).unwrap();
        image::imageops::crop_imm(&map.colours(), 0, 0, 8, 4).to_image().save(&path).unwrap();
        refused("square");
    }

    #[test]
    fn what_was_repainted_is_seen() {
        let old = LabelMap::new(10, 10, vec![7; 100]).unwrap();
        let mut labels = vec![7; 100];
        labels[..30].fill(0);
        labels[30..40].fill(1);
        let new = LabelMap::new(10, 10, labels).unwrap();
        let found = repainted(&old, &new);
        assert!(found.contains(Region::Hair) && found.contains(Region::Face) && !found.contains(Region::Background));
        assert!(repainted(&old, &old).is_empty());
    }
}
