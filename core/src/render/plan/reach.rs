//! How far a surface can lie from the sphere that it starts as, proven from some of its regions.

use super::local::{LocalField, LocalInitial, length};
use crate::config::{DensityKind, Fusion, Residual};

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
    pub fn new(local: &LocalField, regions: usize) -> Option<Self> {
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use candle_core::Device;

    use crate::{
        kernels::Outputs,
        model::generator::Generator,
        region::REGION_COUNT,
        render::{
            RadianceField as _,
            plan::local::{Ready, scaled},
        },
        rng::Stream,
    };

    /// Whatever number of regions is known, in whatever place, the proven distance is below the true one; and the more
    /// is known, the nearer.
    #[test]
    fn no_surface_is_nearer_than_proven() {
        for (model, nearest) in [("cartoon", 0.02), ("portrait", 0.03)] {
            let path = format!("{}/../models/{model}.safetensors", env!("CARGO_MANIFEST_DIR"));
            let generator = Generator::open(Path::new(&path), &Device::Cpu).unwrap();
            let field = generator.field().portraits(&generator.codes_from_seed(5, 1.0).unwrap()).unwrap();
            let ready = Ready::new(field.local(0).unwrap().unwrap(), Outputs::default()).unwrap();
            let (reach, regions) = (ready.reach.as_ref().unwrap(), ready.regions.len());
            let points = Stream::new(9, &[]).normal_tensor(&[400, 3], &Device::Cpu).unwrap().to_vec2::<f32>().unwrap();
            let mut slack = vec![0.0; regions];
            for point in &points {
                let point = [point[0] * 0.1, point[1] * 0.1, point[2] * 0.1];
                let mut raw = vec![0.0; regions * 2];
                for (shape, raw) in ready.shape.iter().zip(raw.chunks_exact_mut(2)) {
                    shape.forward(&point.map(scaled), raw).unwrap();
                }
                let mut masks = [0.0; REGION_COUNT];
                let fused = ready.fuse(&raw, &mut masks[..regions]);
                let distance = ready.distance(point, fused.residual, 0.0);
                let mut known = reach.start(point);
                for (place, region) in reach.order.iter().enumerate() {
                    let least = reach.least_distance(&known, place);
                    assert!(least <= distance, "{model} {point:?}: {place} known, {least} > {distance}");
                    slack[place] += (distance - least) / points.len() as f32;
                    reach.learn(&mut known, &raw[region * 2..][..2]);
                }
            }
            println!("{model}: mean slack by regions known {slack:?}");
            assert!(slack[regions - 1] < nearest && slack[0] > slack[regions - 1], "{model} {slack:?}");
        }
    }
}
