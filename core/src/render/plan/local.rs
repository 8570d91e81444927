//! A field as plain numbers: what a plan reads instead of tensors, and the arithmetic that fuses regions at a point.

use candle_core::{Device, Tensor};

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
    fn ranges(&self, index: usize, head: &Linear) -> impl Iterator<Item = (f32, f32)> {
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

/// How far the surface can lie from the sphere that it starts as. Heads read sines, so a residual is no less than its
/// bias minus the sum of its weights' magnitudes, and a mask's logit no more than its bias plus that sum, whatever the
/// point. Under softmax Σ m_i Δd_i is a mean of the Δd_i: what is known of some of them, and these limits of the others,
/// limit it from below.
#[derive(Clone, Debug)]
pub struct Reach {
    /// The sphere's, world units.
    radius: f32,
    /// Regions, those first that can pull the surface furthest out.
    pub order: Vec<usize>,
    /// In that order: the least Δd of this region and all behind it, world units.
    least: Vec<f32>,
    /// In that order: the largest Σ exp(logit) over this region and all behind it.
    largest: Vec<f32>,
    /// What raw masks are multiplied by.
    sharpness: f32,
    /// World units per unit of a raw residual.
    scale: f32,
}

/// A point as its regions become known in the order of a [`Reach`].
#[derive(Clone, Copy, Debug)]
pub struct PartlyKnown {
    /// Distance to the sphere, world units.
    initial: f32,
    /// Σ exp(logit) of the known regions.
    weight: f32,
    /// Σ exp(logit) Δd of the known regions.
    moment: f32,
}

impl Reach {
    /// What rounding may add to a distance, world units: a thousandth of any α that a surface is rendered with.
    const ROUNDING: f32 = 1e-6;

    /// Of the fields that have one: gated residuals around a sphere, masks that share 1.
    fn new(local: &LocalField, regions: usize) -> Option<Self> {
        let (Fusion::Softmax { sharpness }, Residual::Gated, DensityKind::ResidualSdf, LocalInitial::Sphere { radius }) =
            (local.fusion, local.residual, local.density, &local.initial)
        else {
            return None;
        };
        let (layout, scale) = (local.generators.shape.layout(), local.residual_scale as f32);
        let limits: Vec<(f32, f32)> = (0..regions)
            .filter_map(|region| {
                let (residual, residual_radius) = local.generators.ranges(region, &layout.residual).next()?;
                let (mask, mask_radius) = local.generators.ranges(region, &layout.mask).next()?;
                let logit = mask * sharpness as f32 + mask_radius * sharpness.abs() as f32;
                Some((residual * scale - residual_radius * scale.abs() - Self::ROUNDING, logit.exp() * 1.000_1))
            })
            .collect();
        let mut order: Vec<usize> = (0..limits.len()).collect();
        order.sort_by(|left, right| limits[*left].0.total_cmp(&limits[*right].0));
        let (mut least, mut largest) = (vec![0.0; order.len()], vec![0.0; order.len()]);
        let (mut lowest, mut sum) = (f32::INFINITY, 0.0);
        for (place, region) in order.iter().enumerate().rev() {
            let (residual, weight) = limits[*region];
            // Not `min`: NaN must spread, so that nothing is proven by it.
            lowest = if residual > lowest { lowest } else { residual };
            sum += weight;
            (least[place], largest[place]) = (lowest, sum);
        }
        Some(Self { radius: *radius as f32, order, least, largest, sharpness: sharpness as f32, scale })
    }

    /// A world point of which no region is known.
    pub fn start(&self, point: [f32; 3]) -> PartlyKnown {
        PartlyKnown { initial: length(point) - self.radius, weight: 0.0, moment: 0.0 }
    }

    /// The least signed distance, world units, where the regions before `place` of the order are known. NaN if any of
    /// it is.
    pub fn least_distance(&self, known: &PartlyKnown, place: usize) -> f32 {
        let (least, largest) = (self.least[place], self.largest[place]);
        let mean = if place == 0 {
            least
        } else {
            let mean = known.moment / known.weight;
            // The others pull the mean down the further the more they weigh, but not below what is known if they cannot
            // lie below it.
            if least >= mean { mean } else { (known.moment + largest * least) / (known.weight + largest) }
        };
        known.initial + mean - Self::ROUNDING
    }

    /// One more region is known by its raw mask and residual.
    pub fn learn(&self, known: &mut PartlyKnown, raw: &[f32]) {
        let weight = (raw[0] * self.sharpness).exp();
        known.weight += weight;
        known.moment += weight * raw[1] * self.scale;
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

/// What makes features of activations, see [`LocalFeatures`].
pub struct Features {
    /// Per region, `[W, F]`.
    weights: Vec<Tensor>,
    local: LocalFeatures,
}

impl Features {
    fn new(local: &LocalFeatures, width: usize) -> Result<Self> {
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
