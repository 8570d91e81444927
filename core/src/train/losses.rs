//! What a field is trained by, besides its discriminators: reconstruction, geometry, disentanglement, labels.
//!
//! Every loss is a scalar tensor, a mean over batch and pixels or points, unweighted; differentiable to first order.
//! Losses on ∇d need no second order: the gradient is itself a graph (see [`crate::kernels`]).

use candle_core::{D, Tensor};
use candle_nn::ops::sigmoid;

use crate::{
    error::{Error, Result},
    region::REGION_COUNT,
    render::{RayWeights, norm_over},
};

/// Mean absolute difference of colours `[B, 3, ..]`, both in [-1, 1], in units of the range [0, 1].
pub fn colour_l1(predicted: &Tensor, target: &Tensor) -> Result<Tensor> {
    Ok((mean_absolute(predicted, target)? * 0.5)?)
}

/// Mean squared difference of colours `[B, 3, ..]`, in units of the range [-1, 1] they are in.
pub fn colour_l2(predicted: &Tensor, target: &Tensor) -> Result<Tensor> {
    check_same("target colours", predicted, target)?;
    Ok((predicted - target)?.sqr()?.mean_all()?)
}

/// Squared difference of rendered and true masks `[B, 9, ..]`, summed over the regions with their weights (recipe:
/// 3 for eyes, eyebrows and mouth, 2 for nose and ears, 1 for the others), mean over pixels.
pub fn masks_l2(predicted: &Tensor, target: &Tensor, region_weights: &[f64; REGION_COUNT]) -> Result<Tensor> {
    check_same("target masks", predicted, target)?;
    if predicted.dim(1)? != REGION_COUNT {
        return Err(Error::shape("masks", "[B, 9, ..]", predicted.dims()));
    }
    let weights = Tensor::new(region_weights, predicted.device())?.to_dtype(predicted.dtype())?;
    let squared = (predicted - target)?.sqr()?.flatten_from(1)?.reshape((predicted.dim(0)?, REGION_COUNT, ()))?;
    Ok(squared.broadcast_mul(&weights.reshape((1, REGION_COUNT, 1))?)?.sum(1)?.mean_all()?)
}

/// How close to 0 or 1 an opacity may come before its logarithm is taken (recipe).
const OPACITY_MARGIN: f64 = 1e-4;

/// Binary cross-entropy between what the volume covers of each pixel and what the person covers, any equal shapes,
/// both in [0, 1].
pub fn opacity(predicted: &Tensor, target: &Tensor) -> Result<Tensor> {
    check_same("target opacity", predicted, target)?;
    let bounded = |share: &Tensor| share.maximum(OPACITY_MARGIN)?.minimum(1.0 - OPACITY_MARGIN);
    // Each share is bounded on its own: 1 − (1 − margin) would have lost the margin's digits to rounding.
    let (covered, clear) = (bounded(predicted)?, bounded(&predicted.affine(-1.0, 1.0)?)?);
    let open = target.affine(-1.0, 1.0)?;
    let likelihood = ((target * covered.log()?)? + (open * clear.log()?)?)?;
    Ok(likelihood.neg()?.mean_all()?)
}

/// E (|∇d| - 1)² (paper, Eikonal Loss) of distance gradients `[B, 3, N]`.
pub fn eikonal(gradient: &Tensor) -> Result<Tensor> {
    if gradient.rank() != 3 || gradient.dim(1)? != 3 {
        return Err(Error::shape("distance gradient", "[B, 3, N]", gradient.dims()));
    }
    Ok((norm_over(gradient, 1)? - 1.0)?.sqr()?.mean_all()?)
}

/// The paper's sharpness of [`minimal_surface`], 1 / world units.
pub const MINIMAL_SURFACE_SHARPNESS: f64 = 100.0;

/// E exp(-sharpness |d|) (paper, Minimal Surface Loss) of distances in world units, any shape.
pub fn minimal_surface(distance: &Tensor, sharpness: f64) -> Result<Tensor> {
    Ok((distance.abs()? * -sharpness)?.exp()?.mean_all()?)
}

/// What [`fill`] pulls colours to.
#[derive(Clone, Debug)]
pub struct RegionColours {
    /// Mean colour of each of the volume's k regions in each portrait, in [-1, 1]: `[B, k, 3]`.
    pub mean: Tensor,
    /// 1 where a portrait shows the region, else 0: `[B, k]`.
    pub present: Tensor,
    /// True masks of those regions at the rays' pixels: `[B, k, R]`.
    pub masks: Tensor,
}

/// Pulls a region's colour where another region is seen to its mean colour (recipe), so that an edit which uncovers
/// it finds skin or hair and not noise. `colours` are an evaluation's, `[B, k, 3, R * S]`, before their sigmoid. The
/// weights are taken as they are: the loss moves no geometry. Mean absolute difference in units of [0, 1].
pub fn fill(colours: &Tensor, weights: &RayWeights, regions: &RegionColours) -> Result<Tensor> {
    let weights = RayWeights { weights: weights.weights.detach(), remaining: weights.remaining.detach() };
    let (batch, count, _, _) = colours.dims4()?;
    if regions.mean.dims() != [batch, count, 3] {
        return Err(Error::shape("mean colours", [batch, count, 3], regions.mean.dims()));
    }
    let seen = weights.sum(&sigmoid(colours)?)?; // [B, k, 3, R]
    let light = weights.weights.sum(D::Minus1)?; // [B, R]
    let mean = regions.mean.affine(0.5, 0.5)?.unsqueeze(3)?.broadcast_mul(&light.unsqueeze(1)?.unsqueeze(1)?)?;
    let off = (seen - mean)?.abs()?.mean(2)?; // [B, k, R]
    let share = regions.masks.affine(-1.0, 1.0)?.broadcast_mul(&light.unsqueeze(1)?)?;
    let share = share.broadcast_mul(&regions.present.unsqueeze(2)?)?;
    Ok((off * share)?.mean_all()?)
}

/// Smooth L1 (quadratic within 1 of the target) between predicted and true view directions `[B, 2]`, radians.
pub fn view(predicted: &Tensor, target: &Tensor) -> Result<Tensor> {
    check_same("target view", predicted, target)?;
    let error = (predicted - target)?.abs()?;
    let within = error.minimum(1.0)?;
    Ok(((within.sqr()? * 0.5)? + (error - &within)?)?.mean_all()?)
}

/// Cross-entropy of class scores `[B, C]` with labels `[B]` (integers).
pub fn classification(scores: &Tensor, labels: &Tensor) -> Result<Tensor> {
    let (batch, _) = scores.dims2()?;
    if labels.dims() != [batch] {
        return Err(Error::shape("labels", [batch], labels.dims()));
    }
    // The shift cancels, so it needs no gradient.
    let shifted = scores.broadcast_sub(&scores.detach().max_keepdim(1)?)?;
    let normaliser = shifted.exp()?.sum_keepdim(1)?.log()?;
    let chosen = shifted.gather(&labels.to_dtype(candle_core::DType::U32)?.unsqueeze(1)?, 1)?;
    Ok((normaliser - chosen)?.mean_all()?)
}

/// The pictures that [`shape_texture_decoupling`] compares: each a render of shape codes w^i and texture codes w^j.
#[derive(Clone, Copy, Debug)]
pub struct DecouplingRenders<'a> {
    /// Masks of shape 1, texture 1.
    pub masks: &'a Tensor,
    /// Masks of shape 1, texture 2.
    pub masks_other_texture: &'a Tensor,
    /// Picture of shape 1, texture 1.
    pub picture: &'a Tensor,
    /// Picture of shape 2, texture 1.
    pub picture_other_shape: &'a Tensor,
    /// Picture of shape 2, texture 2.
    pub picture_other_both: &'a Tensor,
}

/// L_STD (paper, Shape Texture Decoupling Loss): masks must not follow the texture, and pictures of one texture must
/// be closer in `features` (φ; one tensor a layer) than pictures of two, by `margin`. The L1 norms are means, so that
/// margin and weight do not depend on the resolution.
pub fn shape_texture_decoupling(
    renders: DecouplingRenders<'_>,
    features: impl Fn(&Tensor) -> Result<Vec<Tensor>>,
    margin: f64,
) -> Result<Tensor> {
    let masks = mean_absolute(renders.masks, renders.masks_other_texture)?;
    let anchor = features(renders.picture)?;
    let distance = |picture: &Tensor| -> Result<Tensor> {
        let other = features(picture)?;
        let layers = anchor.iter().zip(&other).map(|(left, right)| mean_absolute(left, right));
        layers.reduce(|sum, layer| Ok((sum? + layer?)?)).ok_or_else(|| Error::config("features", "φ gave no layer"))?
    };
    let contrast = (distance(renders.picture_other_shape)? - distance(renders.picture_other_both)?)?;
    Ok((masks + (contrast + margin)?.relu()?)?)
}

/// Mean square of latent codes: keeps trained codes near the normal distribution that new ones are drawn from.
pub fn latent(codes: &Tensor) -> Result<Tensor> {
    Ok(codes.sqr()?.mean_all()?)
}

fn mean_absolute(left: &Tensor, right: &Tensor) -> Result<Tensor> {
    check_same("compared tensors", left, right)?;
    Ok((left - right)?.abs()?.mean_all()?)
}

fn check_same(name: &str, expected: &Tensor, found: &Tensor) -> Result<()> {
    if expected.dims() == found.dims() { Ok(()) } else { Err(Error::shape(name, expected.dims(), found.dims())) }
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device, Var};

    use super::*;
    use crate::rng::Stream;

    fn random(seed: u64, shape: &[usize]) -> Tensor {
        Stream::new(seed, &[]).normal_tensor(shape, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
    }

    fn shares(seed: u64, shape: &[usize]) -> Tensor {
        sigmoid(&random(seed, shape)).unwrap()
    }

    fn number(tensor: &Tensor) -> f64 {
        tensor.to_scalar().unwrap()
    }

    /// The gradient of `loss` at `input` against central differences; the losses are smooth at these random inputs.
    fn check(name: &str, input: &Tensor, loss: impl Fn(&Tensor) -> Result<Tensor>) {
        let variable = Var::from_tensor(input).unwrap();
        let gradients = loss(&variable).unwrap().backward().unwrap();
        let gradient: Vec<f64> = gradients.get(&variable).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        let values: Vec<f64> = input.flatten_all().unwrap().to_vec1().unwrap();
        assert!(gradient.iter().any(|value| value.abs() > 1e-6), "{name}: no gradient");
        for index in 0..values.len() {
            let moved = |step: f64| {
                let mut values = values.clone();
                values[index] += step;
                number(&loss(&Tensor::from_vec(values, input.shape(), &Device::Cpu).unwrap()).unwrap())
            };
            let expected = (moved(1e-6) - moved(-1e-6)) / 2e-6;
            let error = (gradient[index] - expected).abs();
            assert!(error < 1e-8 + 1e-6 * expected.abs(), "{name}[{index}]: {} {expected}", gradient[index]);
        }
    }

    #[test]
    fn gradients_match_finite_differences() {
        let colours = random(1, &[2, 3, 4]);
        check("colour_l1", &random(2, &[2, 3, 4]), |x| colour_l1(x, &colours));
        check("colour_l2", &random(2, &[2, 3, 4]), |x| colour_l2(x, &colours));
        let (target, weights) = (shares(3, &[2, 9, 4]), [1.0, 1.0, 3.0, 3.0, 3.0, 2.0, 2.0, 1.0, 1.0]);
        check("masks", &random(4, &[2, 9, 4]), |x| masks_l2(x, &target, &weights));
        check("opacity", &shares(5, &[2, 4]), |x| opacity(x, &shares(6, &[2, 4])));
        check("eikonal", &random(7, &[2, 3, 5]), eikonal);
        check("minimal surface", &(random(8, &[2, 5]).affine(0.02, 0.0).unwrap()), |x| minimal_surface(x, 100.0));
        check("view", &random(9, &[6, 2]).affine(2.0, 0.0).unwrap(), |x| view(x, &random(10, &[6, 2])));
        let labels = Tensor::new(&[3u32, 0, 4], &Device::Cpu).unwrap();
        check("classification", &random(11, &[3, 5]), |x| classification(x, &labels));
        check("latent", &random(12, &[2, 5]), latent);
        let light = RayWeights::new(&shares(13, &[2, 3, 4]), &shares(14, &[2, 3, 4]), false).unwrap();
        let regions = RegionColours {
            mean: random(15, &[2, 8, 3]),
            present: shares(16, &[2, 8]).ge(0.5).unwrap().to_dtype(DType::F64).unwrap(),
            masks: shares(17, &[2, 8, 3]),
        };
        check("fill", &random(18, &[2, 8, 3, 12]), |x| fill(x, &light, &regions));
    }

    #[test]
    fn decoupling_has_both_terms_and_its_margin() {
        let tensors: Vec<Tensor> = (0..5).map(|seed| random(20 + seed, &[1, 3, 2, 2])).collect();
        // A nonlinear φ of two layers.
        let features = |picture: &Tensor| Ok(vec![picture.tanh()?, picture.sqr()?]);
        let renders = |index: usize, input: &Tensor, margin: f64| {
            let at = |own: usize| if own == index { input.clone() } else { tensors[own].clone() };
            let renders = DecouplingRenders {
                masks: &at(0),
                masks_other_texture: &at(1),
                picture: &at(2),
                picture_other_shape: &at(3),
                picture_other_both: &at(4),
            };
            shape_texture_decoupling(renders, features, margin)
        };
        for (index, tensor) in tensors.iter().enumerate().take(5) {
            check(&format!("L_STD input {index}"), tensor, |x| renders(index, x, 10.0));
        }
        let value = |margin| number(&renders(5, &tensors[0], margin).unwrap());
        let masks = number(&mean_absolute(&tensors[0], &tensors[1]).unwrap());
        assert_eq!(value(-100.0), masks, "far below the margin only the masks count");
        assert!((value(11.0) - value(10.0) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn perfect_predictions_cost_nothing() {
        let gradient = Tensor::new(&[[[1.0, 0.0, 0.6], [0.0, -1.0, 0.0], [0.0, 0.0, 0.8]]], &Device::Cpu).unwrap();
        assert!(number(&eikonal(&gradient).unwrap()) < 1e-24);
        let picture = random(1, &[2, 3, 4]);
        assert_eq!(number(&colour_l1(&picture, &picture).unwrap()), 0.0);
        assert!(number(&minimal_surface(&Tensor::new(&[1.0, -1.0], &Device::Cpu).unwrap(), 100.0).unwrap()) < 1e-40);
        let scores = Tensor::new(&[[1e4, 0.0], [0.0, 1e4]], &Device::Cpu).unwrap();
        let labels = Tensor::new(&[0u32, 1], &Device::Cpu).unwrap();
        assert_eq!(number(&classification(&scores, &labels).unwrap()), 0.0);
        assert!(colour_l1(&picture, &picture.narrow(2, 0, 2).unwrap()).is_err());
    }

    #[test]
    fn fill_leaves_regions_that_are_seen_or_absent_alone() {
        let light = RayWeights::new(&shares(1, &[1, 2, 3]), &shares(2, &[1, 2, 3]), false).unwrap();
        let colours = random(3, &[1, 8, 3, 6]);
        let value = |present: f64, mask: f64| {
            let full = |value: f64, shape: &[usize]| Tensor::full(value, shape, &Device::Cpu).unwrap();
            let regions = RegionColours {
                mean: random(4, &[1, 8, 3]),
                present: full(present, &[1, 8]),
                masks: full(mask, &[1, 8, 2]),
            };
            number(&fill(&colours, &light, &regions).unwrap())
        };
        assert_eq!(value(0.0, 0.0), 0.0);
        assert_eq!(value(1.0, 1.0), 0.0);
        assert!(value(1.0, 0.0) > 0.0);
    }
}
