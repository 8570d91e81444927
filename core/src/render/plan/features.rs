//! Features of the regions that a ray sees: linear in activations, so one product a region over the rays that have any.

use candle_core::{Device, Tensor};

use super::local::add_scaled;
use crate::{
    error::Result,
    region::{REGION_COUNT, Region},
};

/// The linear map from activations to features; all portraits'.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalFeatures {
    /// F.
    pub count: usize,
    /// W, or W + 3 with the view direction.
    pub columns: usize,
    /// `[9, F, columns]`.
    pub weight: Vec<f32>,
    /// `[9, F]`.
    pub bias: Vec<f32>,
    /// Whether the last three columns are the view direction's.
    pub sees_view: bool,
}

/// What makes features of activations, see [`LocalFeatures`].
pub struct Features {
    /// Per region, `[W, F]`.
    weights: Vec<Tensor>,
    local: LocalFeatures,
}

impl Features {
    pub fn new(local: &LocalFeatures, width: usize) -> Result<Self> {
        let weight = Tensor::from_slice(&local.weight, (REGION_COUNT, local.count, local.columns), &Device::Cpu)?;
        let weight = weight.narrow(2, 0, width)?.transpose(1, 2)?;
        let weights = (0..REGION_COUNT).map(|region| Ok(weight.get(region)?.contiguous()?)).collect::<Result<_>>()?;
        Ok(Self { weights, local: local.clone() })
    }

    /// F.
    pub fn count(&self) -> usize {
        self.local.count
    }

    /// Adds what a region's activations `[n, W]`, those of `rays`, make of the rays' features `[R, F]`.
    pub fn add(&self, region: Region, rays: &[u32], activations: Vec<f32>, features: &mut [f32]) -> Result<()> {
        let (Some(weight), false) = (self.weights.get(region.index()), rays.is_empty()) else { return Ok(()) };
        let rows = Tensor::from_vec(activations, (rays.len(), weight.dim(0)?), &Device::Cpu)?.matmul(weight)?;
        let rows = rows.flatten_all()?.to_vec1::<f32>()?;
        for (ray, row) in rays.iter().zip(rows.chunks_exact(self.count())) {
            add_scaled(&mut features[*ray as usize * self.count()..][..self.count()], 1.0, row);
        }
        Ok(())
    }

    /// Adds what does not depend on activations: what a ray's masks `[9]` and the direction it is seen from add.
    pub fn add_constant(&self, masks: &[f32], view: [f32; 3], features: &mut [f32]) {
        let LocalFeatures { count, columns, weight, bias, sees_view } = &self.local;
        for (region, mask) in masks.iter().enumerate().filter(|(_, mask)| **mask != 0.0) {
            add_scaled(features, *mask, &bias[region * count..][..*count]);
            if *sees_view {
                let rows = weight[region * count * columns..].chunks_exact(*columns);
                for (feature, row) in features.iter_mut().zip(rows) {
                    let seen = row[columns - 3..].iter().zip(view).map(|(weight, view)| weight * view);
                    *feature += mask * seen.sum::<f32>();
                }
            }
        }
    }
}
