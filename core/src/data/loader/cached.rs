//! A set small enough to be decoded once: any pixel of any item can be looked up.

use rayon::prelude::*;

use super::{Batch, Draw, LoaderConfig, Planes, check_complete, decode, no_such_level};
use crate::{
    camera::Camera,
    data::dataset::Dataset,
    error::{Error, Result},
    region::REGION_COUNT,
};

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
