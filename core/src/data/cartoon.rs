//! Procedural cartoon portraits: training data with exact cameras, label maps, depth and normals.
//!
//! An [`Identity`] holds independent parameters for every region. A [`Portrait`] turns it into solids (signed distance
//! fields joined by fillets) that any [`Camera`] can photograph. [`synth`] makes datasets of them.

mod backdrop;
mod clothes;
mod hair;
mod head;
mod identity;
mod palette;
mod render;
mod scene;
mod shade;
mod shape;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use self::{
    identity::{
        Background, BackgroundKind, Colour, Ears, Eyebrows, Eyes, Face, Garment, Hair, HairStyle, Identity, Mouth,
        Neck, Nose, Pattern,
    },
    render::{CartoonPicture, Portrait, RenderOptions},
};
use crate::{
    camera::Camera,
    error::{Error, Result},
    rng::Stream,
};

/// Names the draws of heads and of cameras among all streams of the suite.
const HEADS: u64 = 0x00ca_4701;
const CAMERAS: u64 = 0x00ca_4702;

/// Renders one picture of an identity. For several cameras build a [`Portrait`] once.
pub fn render(identity: &Identity, camera: &Camera, size: usize, options: &RenderOptions) -> CartoonPicture {
    Portrait::new(identity).render(camera, size, options)
}

/// Which cartoon portraits to make.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct SynthOptions {
    /// Number of heads.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 64))]
    pub count: usize,
    /// Width and height of the pictures, pixels.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 256))]
    pub size: usize,
    /// Cameras drawn per head; every one gives a picture.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 1))]
    pub views: usize,
    /// After each drawn camera, pictures from cameras turned from it in azimuth by so many radians, e.g. -0.4,-0.2,0.2,0.4.
    #[cfg_attr(
        feature = "clap",
        arg(long, value_name = "RAD[,RAD]", value_delimiter = ',', allow_hyphen_values = true)
    )]
    pub turns: Vec<f64>,
    /// Standard deviation of the cameras' azimuth, radians.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 0.4))]
    pub azimuth_sigma: f64,
    /// Standard deviation of the cameras' elevation, radians.
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 0.2))]
    pub elevation_sigma: f64,
}

impl Default for SynthOptions {
    fn default() -> Self {
        Self { count: 64, size: 256, views: 1, turns: Vec::new(), azimuth_sigma: 0.4, elevation_sigma: 0.2 }
    }
}

impl SynthOptions {
    /// Number of pictures: heads × cameras.
    pub fn len(&self) -> usize {
        self.count.saturating_mul(self.cameras_per_head())
    }

    /// Cameras of each head, drawn and turned.
    pub fn cameras_per_head(&self) -> usize {
        self.views.saturating_mul(1 + self.turns.len())
    }

    /// Whether there is nothing to make.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`Error::Config`] with the option's name.
    pub fn validate(&self) -> Result<()> {
        if !(1..=8192).contains(&self.size) {
            return Err(Error::config("size", format!("{} is outside 1 to 8192 pixels", self.size)));
        }
        if self.is_empty() {
            return Err(Error::config(if self.count == 0 { "count" } else { "views" }, "must be at least 1"));
        }
        if let Some(turn) = self.turns.iter().find(|turn| !(-1.6..=1.6).contains(*turn)) {
            return Err(Error::config("turns", format!("{turn} is outside -1.6 to 1.6 radians")));
        }
        for (name, sigma) in [("azimuth-sigma", self.azimuth_sigma), ("elevation-sigma", self.elevation_sigma)] {
            if !(0.0..=10.0).contains(&sigma) {
                return Err(Error::config(name, format!("{sigma} is outside 0 to 10 radians")));
            }
        }
        Ok(())
    }

    /// The seed of a head's [`Identity`].
    pub fn identity_seed(seed: u64, head: usize) -> u64 {
        Stream::new(seed, &[HEADS, head as u64]).bits()
    }

    /// A head's camera: Gaussian angles, clamped to ±1.2 rad azimuth and ±0.6 rad elevation; then turned, if it is not
    /// the first after a draw.
    pub fn camera(&self, seed: u64, head: usize, view: usize) -> Camera {
        let (drawn, place) = (view / (1 + self.turns.len()), view % (1 + self.turns.len()));
        let mut stream = Stream::new(seed, &[CAMERAS, head as u64, drawn as u64]);
        let azimuth = self.azimuth_sigma * f64::from(stream.normal());
        let elevation = self.elevation_sigma * f64::from(stream.normal());
        let turn = place.checked_sub(1).and_then(|place| self.turns.get(place)).copied().unwrap_or(0.0);
        Camera::at(azimuth.clamp(-1.2, 1.2) + turn, elevation.clamp(-0.6, 0.6))
    }
}

/// One picture of a synthetic dataset.
#[derive(Clone, Debug)]
pub struct SynthItem {
    /// Place in the dataset: `head * cameras_per_head + view`.
    pub index: usize,
    /// Number of the head.
    pub head: usize,
    /// Number of the camera of this head.
    pub view: usize,
    /// Seed of the head: `Identity::sample(identity_seed)`.
    pub identity_seed: u64,
    /// Where the camera stood.
    pub camera: Camera,
    /// Picture, labels, depth, normals.
    pub picture: CartoonPicture,
}

/// Makes the pictures of a synthetic dataset, in order, several at a time on rayon's threads. What an item holds depends
/// on `seed` and its index only.
///
/// # Errors
/// [`Error::Config`] if an option is out of range.
pub fn synth(seed: u64, options: SynthOptions, render: RenderOptions) -> Result<Synth> {
    options.validate()?;
    Ok(Synth { seed, options, render, next_head: 0, ready: VecDeque::new() })
}

/// The pictures of a synthetic dataset, see [`synth`].
#[derive(Debug)]
pub struct Synth {
    seed: u64,
    options: SynthOptions,
    render: RenderOptions,
    next_head: usize,
    ready: VecDeque<SynthItem>,
}

impl Synth {
    fn head(&self, head: usize) -> Vec<SynthItem> {
        let identity_seed = SynthOptions::identity_seed(self.seed, head);
        let portrait = Portrait::new(&Identity::sample(identity_seed));
        let cameras = self.options.cameras_per_head();
        (0..cameras)
            .into_par_iter()
            .map(|view| {
                let camera = self.options.camera(self.seed, head, view);
                let picture = portrait.render(&camera, self.options.size, &self.render);
                SynthItem { index: head * cameras + view, head, view, identity_seed, camera, picture }
            })
            .collect()
    }
}

impl Iterator for Synth {
    type Item = SynthItem;

    fn next(&mut self) -> Option<SynthItem> {
        if self.ready.is_empty() {
            // Enough heads to keep all threads busy, few enough to keep memory small.
            let heads = (2 * rayon::current_num_threads()).div_ceil(self.options.cameras_per_head().max(1)).max(1);
            let end = self.next_head.saturating_add(heads).min(self.options.count);
            let batch: Vec<Vec<SynthItem>> =
                (self.next_head..end).into_par_iter().map(|head| self.head(head)).collect();
            self.next_head = end;
            self.ready.extend(batch.into_iter().flatten());
        }
        self.ready.pop_front()
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        let left = (self.options.count - self.next_head) * self.options.cameras_per_head() + self.ready.len();
        (left, Some(left))
    }
}

impl ExactSizeIterator for Synth {}
