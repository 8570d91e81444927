//! What a render should look like, and the losses that say how far it is from that.

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    camera,
    data::{labels::LabelMap, picture},
    model::{field::PortraitField, generator::Generator},
    region::{REGION_COUNT, Region, RegionSet},
    render::{Outputs, RayBundle, RayOutput, Sampling, render_rays},
    rng::Stream,
};
use image::RgbImage;

use crate::{error::Result, likeness::Likeness};

/// How much more a pixel of eyes, brows, mouth, nose or ears counts (recipe).
const DETAIL_BOOST: f32 = 2.0;
/// Where regions are unknown: how much more the centre of the picture counts, where those regions are.
const CENTRE_BOOST: f32 = 1.0;
/// Squared mask errors of small regions count more (recipe), in label order.
const MASK_WEIGHTS: [f32; REGION_COUNT] = [1.0, 1.0, 3.0, 3.0, 3.0, 2.0, 2.0, 1.0, 1.0];

/// The photo as tensors, at the render's and the output's resolution.
pub struct Target {
    /// `[1, 3, r, r]` in [-1, 1].
    pub render: Level,
    /// `[1, 3, R, R]` in [-1, 1].
    pub output: Level,
    /// Perceptual features of the output, taken once.
    features: Option<(Likeness, Vec<Tensor>)>,
}

/// The photo at one resolution.
pub struct Level {
    /// Width and height, pixels.
    pub resolution: usize,
    /// `[1, 3, r, r]` in [-1, 1].
    pub colour: Tensor,
    /// Weight of every pixel, mean 1, `[1, 1, r, r]`.
    pub weight: Tensor,
    /// Each region's share of every pixel, `[1, 9, r, r]`, if known.
    pub masks: Option<Tensor>,
}

impl Level {
    fn new(portrait: &RgbImage, labels: Option<&LabelMap>, resolution: usize, device: &Device) -> Result<Self> {
        let side = resolution as u32;
        let colour = picture::to_tensor(&[picture::resize(portrait, side, side)?], device)?;
        let masks = labels
            .map(|labels| {
                Tensor::from_vec(labels.one_hot(side, side), (1, REGION_COUNT, resolution, resolution), device)
            })
            .transpose()?;
        let weight = match &masks {
            Some(masks) => {
                let detail = Region::Ears.index() - Region::Eyes.index() + 1;
                let detail = masks.narrow(1, Region::Eyes.index(), detail)?.sum_keepdim(1)?;
                detail.affine(f64::from(DETAIL_BOOST), 1.0)?
            }
            None => centre_weight(resolution, device)?,
        };
        let weight = weight.broadcast_div(&weight.mean_all()?)?;
        Ok(Self { resolution, colour, weight, masks })
    }

    /// Some of the pixels, side by side: the level's `[1, C, r, r]` tensors as `[1, C, R]`.
    pub fn pick(&self, tensor: &Tensor, pixels: &Tensor) -> Result<Tensor> {
        Ok(tensor.flatten_from(2)?.index_select(pixels, 2)?)
    }
}

impl Target {
    /// The target of a generator. `portrait` is aligned; `labels` cover it.
    pub fn new(
        portrait: &RgbImage,
        labels: Option<&LabelMap>,
        generator: &Generator,
        likeness: Option<&Likeness>,
    ) -> Result<Self> {
        let device = generator.device();
        let output = Level::new(portrait, labels, generator.output_resolution(), &device)?;
        let features = likeness
            .filter(|likeness| likeness.sees(output.resolution))
            .map(|likeness| Ok::<_, crate::Error>((likeness.clone(), likeness.features(&output.colour)?)))
            .transpose()?;
        Ok(Self { render: Level::new(portrait, labels, generator.render_resolution(), &device)?, output, features })
    }

    /// Perceptual distance of a picture `[1, 3, R, R]` to the photo, a scalar, in LPIPS's size; none without features.
    pub fn perceptual(&self, rgb: &Tensor) -> Result<Option<Tensor>> {
        let Some((likeness, features)) = &self.features else { return Ok(None) };
        Ok(Some(likeness.distance(&likeness.features(rgb)?, features)?))
    }
}

/// Weights of the losses that compare a render with the photo.
#[derive(Clone, Copy, Debug)]
pub struct PhotoWeights {
    /// Mean absolute colour error.
    pub absolute: f64,
    /// Mean squared colour error.
    pub squared: f64,
    /// Perceptual distance.
    pub perceptual: f64,
    /// Squared mask error.
    pub masks: f64,
    /// Cross-entropy of the opacity.
    pub opacity: f64,
}

/// A weighted loss and the plain mean squared colour error it saw.
pub struct Loss {
    /// A scalar.
    pub total: Tensor,
    /// Colour errors of what was compared.
    pub error: Tensor,
    /// Mean squared error, colours in [-1, 1].
    pub squared_error: f64,
}

impl Loss {
    /// Peak signal-to-noise ratio of the compared colours, dB.
    pub fn psnr(&self) -> f64 {
        psnr(self.squared_error)
    }
}

/// Peak signal-to-noise ratio of a mean squared error of colours in [-1, 1], dB; at most 100.
pub fn psnr(squared_error: f64) -> f64 {
    10.0 * (4.0 / squared_error.max(4e-10)).log10()
}

/// Compares rays of the field with the photo's pixels `pixels` (u32 indices in row order).
pub fn ray_loss(output: &RayOutput, level: &Level, pixels: &Tensor, weights: &PhotoWeights) -> Result<Loss> {
    let weight = level.pick(&level.weight, pixels)?;
    let error = (&output.colour - level.pick(&level.colour, pixels)?)?;
    let masks = level.masks.as_ref().map(|masks| level.pick(masks, pixels)).transpose()?;
    let opacity = output.weights.remaining.affine(-1.0, 1.0)?.unsqueeze(1)?;
    weighted(&error, &weight, &output.masks, &opacity, masks.as_ref(), weights)
}

/// Compares the render under a whole picture with the photo: [`ray_loss`] on every pixel.
pub fn frame_loss(frame: &cnerf_core::render::Frame, level: &Level, weights: &PhotoWeights) -> Result<Loss> {
    let error = (&frame.colour - &level.colour)?;
    weighted(&error, &level.weight, &frame.masks, &frame.opacity, level.masks.as_ref(), weights)
}

/// Compares a finished picture `[1, 3, R, R]` with the photo.
pub fn picture_loss(rgb: &Tensor, target: &Target, weights: &PhotoWeights) -> Result<Loss> {
    let error = (rgb - &target.output.colour)?;
    let squared = error.sqr()?;
    let mut total = ((smooth_absolute(&error)?.broadcast_mul(&target.output.weight)?.mean_all()? * weights.absolute)?
        + (squared.broadcast_mul(&target.output.weight)?.mean_all()? * weights.squared)?)?;
    if weights.perceptual > 0.0
        && let Some(distance) = target.perceptual(rgb)?
    {
        total = (total + (distance * weights.perceptual)?)?;
    }
    Ok(Loss { total, squared_error: scalar(&squared.mean_all()?)?, error: error.detach() })
}

fn weighted(
    error: &Tensor,
    weight: &Tensor,
    masks: &Tensor,
    opacity: &Tensor,
    known: Option<&Tensor>,
    weights: &PhotoWeights,
) -> Result<Loss> {
    let squared = error.sqr()?;
    let mut total = ((smooth_absolute(error)?.broadcast_mul(weight)?.mean_all()? * weights.absolute)?
        + (squared.broadcast_mul(weight)?.mean_all()? * weights.squared)?)?;
    if let Some(known) = known {
        let mut shape = vec![1; known.rank()];
        shape[1] = REGION_COUNT;
        let importance = Tensor::new(&MASK_WEIGHTS, known.device())?.reshape(shape)?;
        let off = (masks - known)?.sqr()?.broadcast_mul(&importance)?.sum(1)?.mean_all()?;
        let person = known.narrow(1, 0, 1)?.affine(-1.0, 1.0)?;
        total = ((total + (off * weights.masks)?)? + (cross_entropy(opacity, &person)? * weights.opacity)?)?;
    }
    Ok(Loss { total, squared_error: scalar(&squared.mean_all()?)?, error: error.detach() })
}

/// |x| with a gradient that is 0 at 0: √(x² + ε²) - ε, ε a five-hundredth of the colours' range.
fn smooth_absolute(x: &Tensor) -> Result<Tensor> {
    const EPSILON: f64 = 4e-3;
    Ok(((x.sqr()? + EPSILON * EPSILON)?.sqrt()? - EPSILON)?)
}

/// Mean of -t ln p - (1 - t) ln(1 - p), p kept off 0 and 1 by a thousandth.
fn cross_entropy(p: &Tensor, t: &Tensor) -> Result<Tensor> {
    let p = p.affine(0.998, 0.001)?;
    let likelihood = ((t * p.log()?)? + (t.affine(-1.0, 1.0)? * p.affine(-1.0, 1.0)?.log()?)?)?;
    Ok(likelihood.mean_all()?.neg()?)
}

/// 1 at the edges, 1 + [`CENTRE_BOOST`] in the middle: a bell with a quarter of the picture's width as deviation.
fn centre_weight(resolution: usize, device: &Device) -> Result<Tensor> {
    let bell = |index: usize| {
        let place = ((index as f32 + 0.5) / resolution as f32 - 0.5) / 0.25;
        (-0.5 * place * place).exp()
    };
    let values: Vec<f32> = (0..resolution * resolution)
        .map(|index| 1.0 + CENTRE_BOOST * bell(index % resolution) * bell(index / resolution))
        .collect();
    Ok(Tensor::from_vec(values, (1, 1, resolution, resolution), device)?)
}

/// `count` different pixels of a square picture in random order, u32 indices `[count]`.
pub fn draw_pixels(resolution: usize, count: usize, random: &mut Stream, device: &Device) -> Result<Tensor> {
    let order = random.permutation(resolution * resolution);
    let chosen: Vec<u32> = order.into_iter().take(count.max(1)).map(|index| index as u32).collect();
    let length = chosen.len();
    Ok(Tensor::from_vec(chosen, length, device)?)
}

/// Renders the chosen pixels of one portrait seen by `cameras` `[1, 6]`, samples perturbed.
pub fn render_pixels(
    field: &PortraitField,
    cameras: &Tensor,
    pixels: &Tensor,
    resolution: usize,
    sampling: &Sampling,
    random: &mut Stream,
) -> Result<RayOutput> {
    let depths = sampling.perturbed(1, pixels.elem_count(), random, DType::F32, cameras.device())?;
    render_at(field, cameras, pixels, resolution, sampling, &depths)
}

/// [`render_pixels`] with regular samples: the same picture every time.
pub fn render_regular_pixels(
    field: &PortraitField,
    cameras: &Tensor,
    pixels: &Tensor,
    resolution: usize,
    sampling: &Sampling,
) -> Result<RayOutput> {
    let depths = sampling.regular(DType::F32, cameras.device())?;
    render_at(field, cameras, pixels, resolution, sampling, &depths)
}

fn render_at(
    field: &PortraitField,
    cameras: &Tensor,
    pixels: &Tensor,
    resolution: usize,
    sampling: &Sampling,
    depths: &Tensor,
) -> Result<RayOutput> {
    let centres = camera::pixel_centres(resolution, cameras.device())?.index_select(pixels, 1)?;
    let rays = RayBundle::new(camera::cast(cameras, &centres, resolution, camera::FIELD_OF_VIEW_RAD)?)?;
    let depths = depths.broadcast_as((1, pixels.elem_count(), depths.dim(2)?))?.contiguous()?;
    Ok(render_rays(field, &rays, &depths, sampling, Outputs::default(), RegionSet::ALL)?)
}

/// A scalar tensor's value.
pub fn scalar(tensor: &Tensor) -> Result<f64> {
    Ok(f64::from(tensor.to_dtype(DType::F32)?.to_scalar::<f32>()?))
}

#[cfg(test)]
mod tests {
    use candle_core::Var;

    use super::*;

    #[test]
    fn psnr_is_that_of_unit_colours() {
        assert!((psnr(0.04) - 20.0).abs() < 1e-9);
        assert_eq!(psnr(0.0), 100.0);
    }

    #[test]
    fn gradients_match_finite_differences() {
        let mut random = Stream::new(4, &[]);
        let mut draw = |shape: &[usize]| {
            random.uniform_tensor(shape, 0.05, 0.95, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
        };
        let (error, weight, known) = (draw(&[1, 3, 7]), draw(&[1, 1, 7]), draw(&[1, 9, 7]));
        let (masks, opacity) = (draw(&[1, 9, 7]), draw(&[1, 1, 7]));
        let weights = PhotoWeights { absolute: 1.0, squared: 0.7, perceptual: 0.0, masks: 0.0, opacity: 0.3 };
        let value = |error: &Tensor, opacity: &Tensor| {
            let known = known.narrow(1, 0, 1).unwrap();
            let absolute = smooth_absolute(error).unwrap().broadcast_mul(&weight).unwrap().mean_all().unwrap();
            let entropy = cross_entropy(opacity, &known).unwrap();
            ((absolute * weights.absolute).unwrap() + (entropy * weights.opacity).unwrap()).unwrap()
        };
        let variables = [Var::from_tensor(&error).unwrap(), Var::from_tensor(&opacity).unwrap()];
        let gradients = value(&variables[0], &variables[1]).backward().unwrap();
        for (which, start) in [&error, &opacity].into_iter().enumerate() {
            let direction = draw(start.dims());
            let moved = |step: f64| {
                let there = (start + (&direction * step).unwrap()).unwrap();
                let loss = if which == 0 { value(&there, &opacity) } else { value(&error, &there) };
                loss.to_scalar::<f64>().unwrap()
            };
            let expected = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            let gradient = gradients.get(&variables[which]).unwrap();
            let found = (gradient * &direction).unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap();
            assert!((found - expected).abs() < 1e-7, "{found} {expected}");
        }
        drop(masks);
    }
}
