//! A field as plain numbers: what a plan reads instead of tensors, and the arithmetic that fuses regions at a point.

use super::{
    features::{Features, LocalFeatures},
    reach::Reach,
};
use crate::{
    camera::INPUT_SCALE,
    config::{DensityKind, Fusion, Residual},
    error::Result,
    kernels::{self, HeadShape, Linear, Outputs, PreparedRegion},
    region::{REGION_COUNT, Region, RegionSet},
};

/// Local generators of one portrait.
#[derive(Clone, Debug, PartialEq)]
pub struct LocalWeights {
    /// The networks' sizes.
    pub shape: HeadShape,
    /// `[k, P]`, packed as [`HeadShape::layout`].
    pub weights: Vec<f32>,
    /// `[k, 5, 2, W]`: γ then β of each layer.
    pub film: Vec<f32>,
}

/// The global distance d0.
#[derive(Clone, Debug, PartialEq)]
pub enum LocalInitial {
    /// Residuals alone make the distance.
    None,
    /// |x| - radius, world units.
    Sphere {
        /// World units.
        radius: f64,
    },
    /// One more local generator whose residual head is the distance.
    Network(LocalWeights),
}

/// One portrait's field, see [`super::super::RadianceField::local`].
#[derive(Clone, Debug, PartialEq)]
pub struct LocalField {
    /// The regions that live in the volume, in the order of `generators`.
    pub volume: RegionSet,
    /// Their local generators.
    pub generators: LocalWeights,
    /// The far plane's, if the background is there.
    pub background: Option<LocalWeights>,
    /// The global distance.
    pub initial: LocalInitial,
    /// How raw masks become fusion weights.
    pub fusion: Fusion,
    /// How residuals join.
    pub residual: Residual,
    /// World units per unit of the residual head's output.
    pub residual_scale: f64,
    /// What the distance means.
    pub density: DensityKind,
    /// 1 / α, 1 / world units.
    pub inverse_alpha: f32,
    /// What features are made of.
    pub features: LocalFeatures,
}

impl LocalWeights {
    /// One region's packed weights and FiLM.
    pub fn region(&self, index: usize) -> (&[f32], &[f32]) {
        let (parameters, film) = (self.shape.parameter_count(), kernels::FILM_LAYERS * 2 * self.shape.width);
        (&self.weights[index * parameters..][..parameters], &self.film[index * film..][..film])
    }

    fn prepare(&self, index: usize, outputs: Outputs) -> Result<Box<dyn PreparedRegion<f32>>> {
        let (weights, film) = self.region(index);
        Ok(kernels::selected()?.prepare(self.shape, outputs, weights, film)?)
    }

    /// What `index`'s colour logits can be, whatever the point and the view: the last layer's activations are sines,
    /// so a logit is within its bias ± the sum of its weights' magnitudes; view directions are of unit length.
    fn logit_range(&self, index: usize) -> LogitRange {
        let mut range = LogitRange { middle: [0.0; 3], radius: [0.0; 3] };
        for (channel, (middle, radius)) in self.ranges(index, &self.shape.layout().colour).enumerate() {
            (range.middle[channel], range.radius[channel]) = (middle, radius);
        }
        range
    }

    /// middle and radius of each output of a head of `index`.
    pub(super) fn ranges(&self, index: usize, head: &Linear) -> impl Iterator<Item = (f32, f32)> {
        let (weights, _) = self.region(index);
        let rows = weights[head.weight.clone()].chunks_exact(head.inputs);
        // The sum's own rounding, and sines that round to just above 1.
        let radius = |row: &[f32]| row.iter().map(|weight| weight.abs()).sum::<f32>() * 1.000_01;
        rows.zip(&weights[head.bias.clone()]).map(move |(row, bias)| (*bias, radius(row)))
    }
}

/// middle ± radius of each colour channel's logit.
#[derive(Clone, Copy, Debug)]
pub struct LogitRange {
    pub middle: [f32; 3],
    pub radius: [f32; 3],
}

impl LogitRange {
    /// The largest magnitude of a logit.
    pub fn largest(&self) -> f32 {
        self.middle.iter().zip(self.radius).fold(0.0, |largest, (middle, radius)| largest.max(middle.abs() + radius))
    }

    pub fn largest_radius(&self) -> f32 {
        self.radius.iter().fold(0.0, |largest, radius| largest.max(*radius))
    }
}

/// A point's fused values.
#[derive(Clone, Copy, Debug)]
pub struct FusedPoint {
    /// What the regions add to the distance, world units (the negated sum for a density).
    pub residual: f32,
    /// Σ m_i Δd_i, world units: what [`Ready::normal_share`] needs.
    pub mean: f32,
}

/// A [`LocalField`] ready to be evaluated at lists of points.
pub struct Ready {
    pub local: LocalField,
    pub regions: Vec<Region>,
    pub shape: Vec<Box<dyn PreparedRegion<f32>>>,
    pub heads: Vec<Box<dyn PreparedRegion<f32>>>,
    pub background: Option<Box<dyn PreparedRegion<f32>>>,
    pub initial: Option<Box<dyn PreparedRegion<f32>>>,
    pub ranges: Vec<LogitRange>,
    pub background_range: Option<LogitRange>,
    pub reach: Option<Reach>,
    /// Features of activations, where they are shown.
    pub features: Option<Features>,
}

/// sum += scale · terms.
pub fn add_scaled(sum: &mut [f32], scale: f32, terms: &[f32]) {
    for (sum, term) in sum.iter_mut().zip(terms) {
        *sum += scale * term;
    }
}

impl Ready {
    pub fn new(local: LocalField, outputs: Outputs) -> Result<Self> {
        let regions: Vec<Region> = local.volume.iter().collect();
        let all = |outputs: Outputs| -> Result<Vec<_>> {
            (0..regions.len()).map(|index| local.generators.prepare(index, outputs)).collect()
        };
        let far = Outputs { gradient: false, ..outputs };
        let slope = Outputs { gradient: outputs.gradient, ..Outputs::default() };
        Ok(Self {
            shape: all(Outputs::default())?,
            heads: all(outputs)?,
            background: local.background.as_ref().map(|weights| weights.prepare(0, far)).transpose()?,
            initial: match &local.initial {
                LocalInitial::Network(weights) => Some(weights.prepare(0, slope)?),
                _ => None,
            },
            ranges: (0..regions.len()).map(|index| local.generators.logit_range(index)).collect(),
            background_range: local.background.as_ref().map(|weights| weights.logit_range(0)),
            reach: Reach::new(&local, regions.len()),
            features: if outputs.activations {
                Some(Features::new(&local.features, local.generators.shape.width)?)
            } else {
                None
            },
            regions,
            local,
        })
    }

    /// Values of a point that the generators read: 3, or 6 with the view direction.
    pub fn columns(&self) -> usize {
        self.local.generators.shape.point_columns()
    }

    /// Masks (the first k of `masks`) from k pairs of raw mask and residual, in the order of operations of the field's
    /// tensors: distances then differ from theirs by no more than d0's rounding.
    pub fn fuse(&self, raw: &[f32], masks: &mut [f32]) -> FusedPoint {
        let scale = self.local.residual_scale as f32;
        match self.local.fusion {
            Fusion::Raw => {
                for (mask, raw) in masks.iter_mut().zip(raw.chunks_exact(2)) {
                    *mask = raw[0];
                }
            }
            Fusion::Softmax { sharpness } => {
                let sharpness = sharpness as f32;
                let mut largest = f32::NEG_INFINITY;
                for (mask, raw) in masks.iter_mut().zip(raw.chunks_exact(2)) {
                    *mask = raw[0] * sharpness;
                    largest = largest.max(*mask);
                }
                let mut sum = 0.0;
                for mask in masks.iter_mut() {
                    *mask = (*mask - largest).exp();
                    sum += *mask;
                }
                for mask in masks.iter_mut() {
                    *mask /= sum;
                }
            }
        }
        let (mut mean, mut residual) = (0.0, 0.0);
        for (mask, raw) in masks.iter().zip(raw.chunks_exact(2)) {
            let own = raw[1] * scale;
            mean += mask * own;
            residual += own;
        }
        if self.local.residual == Residual::Gated {
            residual = mean;
        }
        if self.local.density == DensityKind::Density {
            residual = -residual;
        }
        FusedPoint { residual, mean }
    }

    /// The whole distance at a world point whose regions add `residual`; `network` is the initial network's output.
    pub fn distance(&self, point: [f32; 3], residual: f32, network: f32) -> f32 {
        if self.local.density != DensityKind::ResidualSdf {
            return residual;
        }
        match &self.local.initial {
            LocalInitial::None => residual,
            LocalInitial::Sphere { radius } => residual + (length(point) - *radius as f32),
            LocalInitial::Network(_) => residual + network,
        }
    }

    /// Density, 1 / world units, at a signed distance.
    pub fn density(&self, distance: f32) -> f32 {
        if self.local.density == DensityKind::Density {
            let scale = self.local.residual_scale as f32;
            let sum = -distance / scale;
            return (sum.max(0.0) + (1.0 + (-sum.abs()).exp()).ln()) / scale;
        }
        let inverse = self.local.inverse_alpha;
        sigmoid(-distance * inverse) * inverse
    }

    /// From which signed distance on, world units, density is at most `density`, 1 / world units; infinity if that is not
    /// known.
    pub fn distance_of(&self, density: f32) -> f32 {
        if self.local.density == DensityKind::Density {
            return f32::INFINITY;
        }
        let alpha = 1.0 / self.local.inverse_alpha;
        // Density never exceeds 1 / α.
        (1.0 / (alpha * density) - 1.0).max(f32::MIN_POSITIVE).ln() * alpha
    }

    /// What multiplies a region's ∇raw mask in ∇d, given its mask, its Δd (world units) and Σ m_j Δd_j: see the
    /// field's `residual_gradient`. 0 unless residuals are gated.
    pub fn normal_share(&self, mask: f32, own: f32, mean: f32) -> f32 {
        match (self.local.residual, self.local.fusion) {
            (Residual::Sum, _) => 0.0,
            (Residual::Gated, Fusion::Raw) => own,
            (Residual::Gated, Fusion::Softmax { sharpness }) => mask * (own - mean) * sharpness as f32,
        }
    }

    /// The row of each region of the volume among all nine.
    pub fn rows(&self) -> impl Iterator<Item = usize> + '_ {
        self.regions.iter().map(|region| region.index())
    }
}

/// Network units of a world coordinate.
pub fn scaled(coordinate: f32) -> f32 {
    coordinate * INPUT_SCALE as f32
}

/// As [`crate::render::norm`].
pub fn length(vector: [f32; 3]) -> f32 {
    (vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2] + 1e-16).sqrt()
}

/// 1 / (1 + exp(-x)).
pub fn sigmoid(x: f32) -> f32 {
    1.0 / (1.0 + (-x).exp())
}

const _: () = assert!(REGION_COUNT <= 16, "sets of regions are kept in 16 bits");

#[cfg(test)]
mod tests {
    use std::path::Path;

    use candle_core::Device;

    use super::*;
    use crate::{model::generator::Generator, render::RadianceField as _};

    #[test]
    fn distances_are_found_for_densities() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/cartoon.safetensors");
        let generator = Generator::open(Path::new(path), &Device::Cpu).unwrap();
        let field = generator.field().portraits(&generator.codes_from_seed(5, 1.0).unwrap()).unwrap();
        let ready = Ready::new(field.local(0).unwrap().unwrap(), Outputs::default()).unwrap();
        for density in [1e-3, 1.0, 100.0] {
            let found = ready.density(ready.distance_of(density));
            assert!((found / density - 1.0).abs() < 1e-3, "{found} {density}");
        }
        // Denser than anything gets: everywhere is less dense.
        assert!(ready.density(ready.distance_of(1e9)) > 0.99 * ready.local.inverse_alpha);
    }
}
