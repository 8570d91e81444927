//! Volume aggregation along rays (paper, Volume Aggregation): from densities to weights, from weighted samples to
//! pixels. Transmittance is kept as optical depth, its logarithm, so that no product of many factors can underflow.

use candle_core::{D, Tensor};
use candle_nn::ops::sigmoid;

use crate::{
    camera,
    error::{Error, Result},
    region::{REGION_COUNT, RegionSet},
    render::{BackgroundEvaluation, Evaluation, RadianceField, RayBundle, norm_over},
};

/// Beyond this optical depth a sample is opaque in every float format; the bound keeps infinite densities finite.
const OPAQUE: f64 = 100.0;

/// How much of a pixel each of its ray's samples makes up.
#[derive(Clone, Debug)]
pub struct RayWeights {
    /// `[B, R, S]`, at least 0; with `remaining` they sum to 1.
    pub weights: Tensor,
    /// Transmittance behind the last sample, `[B, R]`.
    pub remaining: Tensor,
}

impl RayWeights {
    /// Weights T_i (1 - exp(-σ_i δ_i)) with T_i = exp(-Σ_{j<i} σ_j δ_j), from densities `[B, R, S]` (1 / world
    /// units) and interval lengths δ `[B, R, S]` (world units). When `closed`, the last sample takes all that is
    /// left.
    pub fn new(density: &Tensor, lengths: &Tensor, closed: bool) -> Result<Self> {
        let samples = density.dim(D::Minus1)?;
        if samples == 0 {
            return Err(Error::shape("density", "[B, R, S] with at least one sample", density.dims()));
        }
        let optical = density.broadcast_mul(lengths)?.minimum(OPAQUE)?;
        let through = optical.cumsum(D::Minus1)?;
        let first = through.narrow(D::Minus1, 0, 1)?.zeros_like()?;
        let before = Tensor::cat(&[&first, &through.narrow(D::Minus1, 0, samples - 1)?], D::Minus1)?;
        let arriving = before.neg()?.exp()?;
        if closed {
            let last = arriving.narrow(D::Minus1, samples - 1, 1)?;
            let head = arriving.narrow(D::Minus1, 0, samples - 1)?;
            let head = (head * absorbed(&optical.narrow(D::Minus1, 0, samples - 1)?)?)?;
            let remaining = last.squeeze(D::Minus1)?.zeros_like()?;
            return Ok(Self { weights: Tensor::cat(&[head, last], D::Minus1)?, remaining });
        }
        let remaining = through.narrow(D::Minus1, samples - 1, 1)?.squeeze(D::Minus1)?.neg()?.exp()?;
        Ok(Self { weights: (arriving * absorbed(&optical)?)?, remaining })
    }

    /// Σ_s weight x value, from values `[B, .., R * S]` to `[B, .., R]`.
    pub fn sum(&self, values: &Tensor) -> Result<Tensor> {
        let (batch, rays, samples) = self.weights.dims3()?;
        let channels: usize = values.dims().iter().skip(1).rev().skip(1).product();
        let mut shape = values.dims().to_vec();
        if shape.last() != Some(&(rays * samples)) || shape.first() != Some(&batch) {
            return Err(Error::shape("sampled values", format!("[{batch}, .., {}]", rays * samples), values.dims()));
        }
        let weighted = values.reshape((batch, channels, rays, samples))?.broadcast_mul(&self.weights.unsqueeze(1)?)?;
        if let Some(last) = shape.last_mut() {
            *last = rays;
        }
        Ok(weighted.sum(D::Minus1)?.reshape(shape)?)
    }
}

/// 1 - exp(-x), to full relative accuracy however small x is: tanh(x / 2) (1 + exp(-x)).
fn absorbed(optical: &Tensor) -> Result<Tensor> {
    Ok(((optical * 0.5)?.tanh()? * (optical.neg()?.exp()? + 1.0)?)?)
}

/// Pixels, one a ray.
#[derive(Clone, Debug)]
pub struct RayOutput {
    /// `[B, 3, R]` in [-1, 1].
    pub colour: Tensor,
    /// `[B, F, R]`, if asked for.
    pub features: Option<Tensor>,
    /// Share of each region, `[B, 9, R]`; raw masks are not limited in range.
    pub masks: Tensor,
    /// Expected depth along the view axis, world units, `[B, R]`; what is left of the ray lies on the far plane.
    pub depth: Tensor,
    /// Expected point, world, `[B, 3, R]`.
    pub point: Tensor,
    /// Expected outward normal, world, unit length where there is a surface: `[B, 3, R]`, if asked for.
    pub normal: Option<Tensor>,
    /// The samples' weights and the transmittance that is left.
    pub weights: RayWeights,
    /// Depths of the samples, `[B, R, S]` or broadcastable to it.
    pub depths: Tensor,
    /// The field at the samples, `N = R * S`.
    pub evaluation: Evaluation,
}

/// Aggregates an `evaluation` with colours at `depths` `[B, R, S]` of `rays`.
///
/// Colour is -1 + 2 Σ w sigmoid(Σ m_i c_i) (authors' code). Regions outside `shown` give no colour, features or
/// masks: where only they are, the picture is mid-grey. Distances and weights are those of the whole head.
pub fn aggregate<F: RadianceField>(
    field: &F,
    rays: &RayBundle,
    depths: &Tensor,
    weights: RayWeights,
    evaluation: Evaluation,
    background: Option<&BackgroundEvaluation>,
    shown: RegionSet,
) -> Result<RayOutput> {
    let colours = evaluation.colours.as_ref().ok_or_else(|| missing("colours"))?;
    let volume = field.volume_regions();
    let masks = only(&evaluation.masks, volume, shown)?;
    let background = background.filter(|_| shown.contains(crate::region::Region::Background));

    let logits = masks.unsqueeze(2)?.broadcast_mul(colours)?.sum(1)?;
    let mut colour = weights.sum(&sigmoid(&logits)?)?;
    let remaining = weights.remaining.unsqueeze(1)?;
    if volume != RegionSet::ALL {
        let behind = match background {
            Some(background) => sigmoid(&background.colour)?.broadcast_mul(&remaining)?,
            None => (&remaining * 0.5)?.broadcast_as(colour.shape())?.contiguous()?,
        };
        colour = (colour + behind)?;
    }

    let behind = background.map(|_| &remaining);
    let pixel_masks = all_regions(&weights.sum(&masks)?, volume, behind)?;
    let features = match &evaluation.activations {
        Some(activations) => {
            let (batch, count, samples) = weights.weights.dims3()?;
            let share = masks.broadcast_mul(&weights.weights.reshape((batch, 1, count * samples))?)?;
            let activations = activations.ray_sum(&share, samples)?;
            let behind = match background.and_then(|background| background.activations.as_ref()) {
                Some(activations) => Some(activations.broadcast_mul(&remaining)?.unsqueeze(1)?),
                None => None,
            };
            let activations = all_regions(&activations, volume, behind.as_ref())?;
            Some(field.features(&activations, &pixel_masks, Some(&rays.view_directions))?)
        }
        None => None,
    };

    let depth = (weights.weights.broadcast_mul(depths)?.sum(D::Minus1)? + (&weights.remaining * camera::FAR)?)?;
    let point = rays.directions.broadcast_mul(&depth.unsqueeze(2)?)?.broadcast_add(&rays.origins)?;
    let normal = match &evaluation.gradient {
        Some(gradient) => {
            let normal = weights.sum(gradient)?;
            // 1e-3 keeps normals of rays that meet next to nothing at next to nothing.
            let length = (norm_over(&normal, 1)?.sqr()? + 1e-6)?.sqrt()?;
            Some(normal.broadcast_div(&length.unsqueeze(1)?)?)
        }
        None => None,
    };
    Ok(RayOutput {
        colour: colour.affine(2.0, -1.0)?,
        features,
        masks: pixel_masks,
        depth,
        point: point.transpose(1, 2)?.contiguous()?,
        normal,
        weights,
        depths: depths.clone(),
        evaluation,
    })
}

fn missing(quantity: &str) -> Error {
    Error::config("outputs", format!("rendering needs the field's {quantity}; ask for them"))
}

/// `masks` `[B, k, N]` with the rows of regions that are not shown set to 0.
fn only(masks: &Tensor, volume: RegionSet, shown: RegionSet) -> Result<Tensor> {
    if volume.iter().all(|region| shown.contains(region)) {
        return Ok(masks.clone());
    }
    let selection: Vec<f32> = volume.iter().map(|region| f32::from(u8::from(shown.contains(region)))).collect();
    let selection = Tensor::new(selection, masks.device())?.to_dtype(masks.dtype())?.reshape((1, (), 1))?;
    Ok(masks.broadcast_mul(&selection)?)
}

/// Rows of the volume's regions `[B, k, ..]` put in place among all nine; `background` `[B, 1, ..]` is the first row
/// if it is not in the volume.
fn all_regions(rows: &Tensor, volume: RegionSet, background: Option<&Tensor>) -> Result<Tensor> {
    if volume == RegionSet::ALL {
        return Ok(rows.clone());
    }
    if volume != RegionSet::FOREGROUND || rows.dim(1)? != REGION_COUNT - 1 {
        return Err(Error::config("field", format!("regions {volume} make no volume: all, or all but the background")));
    }
    let first = match background {
        Some(background) => background.clone(),
        None => rows.narrow(1, 0, 1)?.zeros_like()?,
    };
    Ok(Tensor::cat(&[&first, rows], 1)?)
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device, Var};
    use proptest::prelude::*;

    use super::*;

    fn tensor(values: &[f64], samples: usize) -> Tensor {
        Tensor::from_slice(values, (1, values.len() / samples, samples), &Device::Cpu).unwrap()
    }

    fn vector(tensor: &Tensor) -> Vec<f64> {
        tensor.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    /// Densities from nothing to far beyond opaque.
    fn rays() -> impl Strategy<Value = (Vec<f64>, Vec<f64>)> {
        let density = prop_oneof![Just(0.0), 1e-9..1e-3, 0.1..50.0, 1e3..1e12].boxed();
        (1..12usize).prop_flat_map(move |samples| {
            (prop::collection::vec(density.clone(), samples), prop::collection::vec(1e-4..0.1, samples))
        })
    }

    proptest! {
        #[test]
        fn weights_share_out_the_light((density, lengths) in rays(), closed: bool) {
            let samples = density.len();
            let ray = |dtype| {
                let tensor = |values| tensor(values, samples).to_dtype(dtype).unwrap();
                RayWeights::new(&tensor(&density), &tensor(&lengths), closed).unwrap()
            };
            let (exact, single) = (ray(DType::F64), ray(DType::F32));
            let (weights, remaining) = (vector(&exact.weights), vector(&exact.remaining)[0]);
            prop_assert!(weights.iter().all(|weight| *weight >= 0.0));
            prop_assert!((weights.iter().sum::<f64>() - (1.0 - remaining)).abs() < 1e-12);
            prop_assert!(!closed || remaining == 0.0);
            // Each weight is at most the light that arrives, and light only gets less.
            let mut light = 1.0;
            for (sample, weight) in weights.iter().enumerate() {
                prop_assert!(*weight <= light + 1e-12);
                let optical: f64 = density[..sample].iter().zip(&lengths).map(|(d, l)| (d * l).min(OPAQUE)).sum();
                let expected = (-optical).exp() * if closed && sample + 1 == samples { 1.0 } else {
                    -(-(density[sample] * lengths[sample]).min(OPAQUE)).exp_m1()
                };
                prop_assert!((weight - expected).abs() <= 1e-12 * expected + 1e-300, "{weight} {expected}");
                light -= weight;
            }
            // f32: the optical depth's rounding (6e-8 of at most 100 where the weight is not yet 0) is the weight's.
            for (single, exact) in vector(&single.weights).iter().zip(&weights) {
                prop_assert!(single.is_finite() && (single - exact).abs() <= 2e-5 * exact + 1e-30, "{single} {exact}");
            }
        }

        #[test]
        fn transmittance_is_monotone_in_density((density, lengths) in rays(), factor in 1.0..3.0f64) {
            let samples = density.len();
            let denser: Vec<f64> = density.iter().map(|value| value * factor).collect();
            let remaining = |density: &[f64]| {
                let weights = RayWeights::new(&tensor(density, samples), &tensor(&lengths, samples), false).unwrap();
                vector(&weights.remaining)[0]
            };
            prop_assert!(remaining(&denser) <= remaining(&density));
        }
    }

    #[test]
    fn thin_samples_keep_their_relative_accuracy_in_f32() {
        let density = Tensor::new(&[[[1e-9f32, 1e-6, 1e-3]]], &Device::Cpu).unwrap();
        let weights = RayWeights::new(&density, &density.ones_like().unwrap(), false).unwrap();
        for (weight, expected) in vector(&weights.weights).iter().zip([1e-9, 1e-6, 9.995e-4]) {
            assert!((weight / expected - 1.0).abs() < 1e-5, "{weight} {expected}");
        }
    }

    #[test]
    fn gradients_of_weights_match_finite_differences() {
        let (density, lengths) = ([3.0, 0.0, 40.0, 7.0, 1e-7, 20.0], [0.02, 0.03, 0.01, 0.05, 0.04, 0.02]);
        let value = |density: &Tensor, closed| {
            let weights = RayWeights::new(density, &tensor(&lengths, 3), closed).unwrap();
            let factors = tensor(&[0.3, -1.0, 2.0, 0.7, 0.1, -0.4], 3);
            let sum = (weights.weights * factors).unwrap().sum_all().unwrap();
            (sum + weights.remaining.sqr().unwrap().sum_all().unwrap()).unwrap()
        };
        for closed in [false, true] {
            let variable = Var::from_tensor(&tensor(&density, 3)).unwrap();
            let gradients = value(&variable, closed).backward().unwrap();
            let gradient = vector(gradients.get(&variable).unwrap());
            for index in 0..density.len() {
                let step = 1e-5;
                let moved = |sign: f64| {
                    let mut density = density;
                    density[index] += sign * step;
                    value(&tensor(&density, 3), closed).to_scalar::<f64>().unwrap()
                };
                let expected = (moved(1.0) - moved(-1.0)) / (2.0 * step);
                assert!((gradient[index] - expected).abs() < 1e-8, "{} {expected}", gradient[index]);
            }
        }
    }
}
