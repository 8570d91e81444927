//! A cascade of linear regressors from gradient histograms to the move that frames a face (Xiong and De la Torre,
//! "Supervised Descent Method", CVPR 2013, with a similarity transform in place of landmarks).
//!
//! Fitted by `cargo run --release -p cnerf-invert --example fit_alignment` to the training portraits: what is
//! embedded is a table of regression weights, no picture.

use std::{f64::consts::TAU, sync::OnceLock};

use cnerf_core::camera::Camera;
use image::RgbImage;
use safetensors::{Dtype, SafeTensors};

use super::CropTransform;
use crate::{
    detect::Face,
    error::{Error, Result},
};

/// Weights fitted by the example `fit_alignment`.
const EMBEDDED: &[u8] = include_bytes!("../../assets/alignment.safetensors");

/// Values of one step: right, down (in half sides of the crop), ln scale, clockwise turn.
pub const STEP_OUTPUTS: usize = 4;
/// Values of the head pose: azimuth, elevation, roll, radians.
pub const POSE_OUTPUTS: usize = 3;
/// Cells of the gradient histogram along one side.
const CELLS: usize = 8;
/// Signed gradient directions told apart.
const DIRECTIONS: usize = 8;
/// Pixels along a cell.
const CELL_PIXELS: usize = 8;
/// The part of the crop that is read, relative to its width: the face, little hair, no corners.
const EXTENT: f64 = 0.72;
/// Length of a feature vector: the histogram and a constant 1.
pub const FEATURES: usize = CELLS * CELLS * DIRECTIONS + 1;

/// Histograms of gradient directions over the crop's inner part (Dalal and Triggs, CVPR 2005, signed directions,
/// votes shared between neighbouring cells and directions), followed by a constant 1.
pub fn features(photo: &RgbImage, transform: &CropTransform) -> Vec<f32> {
    const SIDE: usize = CELLS * CELL_PIXELS;
    // One pixel more on each side for central differences.
    let padded = SIDE + 2;
    let extent = EXTENT * padded as f64 / SIDE as f64;
    let grey: Vec<f64> = (0..padded * padded)
        .map(|index| {
            let (column, row) = ((index % padded) as u32, (index / padded) as u32);
            let [red, green, blue] = transform.area_mean(photo, column, row, padded as u32, extent);
            // The square root evens out contrast between light and dark skin.
            (0.299 * red + 0.587 * green + 0.114 * blue).max(0.0).sqrt()
        })
        .collect();
    let mut histogram = vec![0.0; CELLS * CELLS * DIRECTIONS];
    for row in 0..SIDE {
        for column in 0..SIDE {
            let at = |right: usize, down: usize| grey[(row + down) * padded + column + right];
            let (dx, dy) = (at(2, 1) - at(0, 1), at(1, 2) - at(1, 0));
            let strength = dx.hypot(dy);
            let direction = dy.atan2(dx).rem_euclid(TAU) / TAU * DIRECTIONS as f64;
            for (x, x_share) in neighbours(column) {
                for (y, y_share) in neighbours(row) {
                    let cell = (y * CELLS + x) * DIRECTIONS;
                    let share = strength * x_share * y_share;
                    let (first, part) = (direction as usize % DIRECTIONS, direction.fract());
                    histogram[cell + first] += share * (1.0 - part);
                    histogram[cell + (first + 1) % DIRECTIONS] += share * part;
                }
            }
        }
    }
    normalise(&mut histogram);
    histogram.into_iter().map(|value| value as f32).chain([1.0]).collect()
}

/// The two cells nearest a pixel along one axis, inside the grid, with their shares of its vote.
fn neighbours(pixel: usize) -> impl Iterator<Item = (usize, f64)> {
    let place = (pixel as f64 + 0.5) / CELL_PIXELS as f64 - 0.5;
    let first = place.floor();
    [(first, 1.0 - (place - first)), (first + 1.0, place - first)]
        .into_iter()
        .filter(|(cell, _)| (0.0..CELLS as f64).contains(cell))
        .map(|(cell, share)| (cell as usize, share))
}

/// Divides every cell by the gradient strength of the 3x3 cells around it: lighting falls out.
fn normalise(histogram: &mut [f64]) {
    let energy: Vec<f64> =
        histogram.chunks_exact(DIRECTIONS).map(|cell| cell.iter().map(|value| value * value).sum()).collect();
    let floor = 0.02 * energy.iter().sum::<f64>() / energy.len() as f64 + 1e-6;
    for (index, cell) in histogram.chunks_exact_mut(DIRECTIONS).enumerate() {
        let (x, y) = (index % CELLS, index / CELLS);
        let mut around = 0.0;
        for row in y.saturating_sub(1)..(y + 2).min(CELLS) {
            for column in x.saturating_sub(1)..(x + 2).min(CELLS) {
                around += energy[row * CELLS + column];
            }
        }
        let norm = (around + floor).sqrt();
        // Square roots of shares: Hellinger's kernel, in which linear maps do better.
        cell.iter_mut().for_each(|value| *value = (*value / norm).sqrt());
    }
}

/// The fitted cascade.
#[derive(Clone, Debug, Default)]
pub struct Regressor {
    /// Crop of a detector's box: offset right and down, and half side, all in box widths.
    pub box_to_crop: [f64; 3],
    /// Per stage `[FEATURES, STEP_OUTPUTS]`, row-major.
    pub stages: Vec<Vec<f32>>,
    /// `[FEATURES, POSE_OUTPUTS]`, row-major.
    pub pose: Vec<f32>,
}

impl Regressor {
    /// The cascade that ships with the library.
    pub fn embedded() -> Result<&'static Self> {
        static CASCADE: OnceLock<Option<Regressor>> = OnceLock::new();
        CASCADE
            .get_or_init(|| Self::parse(EMBEDDED))
            .as_ref()
            .ok_or_else(|| Error::malformed("the embedded alignment cascade", "has missing or misshapen tensors"))
    }

    /// The first crop of a face: the mean relation between boxes and crops in the training portraits.
    pub fn start(&self, face: &Face) -> CropTransform {
        let [right, down, half_side] = self.box_to_crop.map(|value| value * face.width);
        CropTransform { centre_x: face.centre_x + right, centre_y: face.centre_y + down, half_side, angle_rad: 0.0 }
    }

    /// `transform` after every stage's step.
    pub fn refine(&self, photo: &RgbImage, transform: CropTransform) -> CropTransform {
        self.stages.iter().fold(transform, |transform, weights| {
            let step: [f64; STEP_OUTPUTS] = apply(weights, &features(photo, &transform));
            // A step longer than any seen in fitting is an extrapolation: bound it.
            transform.moved(step.map(|value| value.clamp(-0.35, 0.35)))
        })
    }

    /// The camera of the head pose in an aligned crop.
    pub fn pose(&self, photo: &RgbImage, transform: &CropTransform) -> Camera {
        let [azimuth, elevation, roll]: [f64; POSE_OUTPUTS] = apply(&self.pose, &features(photo, transform));
        Camera { roll_rad: roll.clamp(-0.3, 0.3), ..Camera::at(azimuth.clamp(-0.9, 0.9), elevation.clamp(-0.5, 0.5)) }
    }

    fn parse(bytes: &[u8]) -> Option<Self> {
        let file = SafeTensors::deserialize(bytes).ok()?;
        let read = |name: &str, length: usize| {
            let tensor = file.tensor(name).ok().filter(|t| t.dtype() == Dtype::F32)?;
            let values: Vec<f32> = tensor
                .data()
                .chunks_exact(4)
                .map(|word| f32::from_le_bytes([word[0], word[1], word[2], word[3]]))
                .collect();
            (values.len() == length).then_some(values)
        };
        let stages = (0..).map_while(|index| read(&format!("stage{index}"), FEATURES * STEP_OUTPUTS)).collect();
        let box_to_crop = read("box_to_crop", 3)?;
        Some(Self {
            box_to_crop: std::array::from_fn(|index| f64::from(box_to_crop[index])),
            stages,
            pose: read("pose", FEATURES * POSE_OUTPUTS)?,
        })
    }
}

/// `features` times a row-major `[FEATURES, N]` matrix.
fn apply<const N: usize>(weights: &[f32], features: &[f32]) -> [f64; N] {
    let mut result = [0.0; N];
    for (row, feature) in weights.chunks_exact(N).zip(features) {
        for (sum, weight) in result.iter_mut().zip(row) {
            *sum += f64::from(*weight) * f64::from(*feature);
        }
    }
    result
}
