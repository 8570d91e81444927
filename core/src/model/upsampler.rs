//! The 2D generators that lift the field's small renders to the output resolution: the recipe's [`residual`] network
//! and the paper's [`stylegan2`]. Both read the render, its region masks and its features, and are modulated either
//! by one global code or, per pixel, by the codes of the regions that own the pixel.

pub mod residual;
pub mod stylegan2;

use candle_core::Tensor;

use self::{residual::ResidualUpsampler, stylegan2::StyleGan2Upsampler};
use crate::{
    config::{UpsamplerConfig, UpsamplerKind, UpsamplerStyle},
    error::{Error, Result},
    model::layers::Resampling,
    parameters::Parameters,
    region::REGION_COUNT,
    rng::Stream,
};

/// What the field rendered, at the upsampler's input resolution or a crop of it.
#[derive(Clone, Debug)]
pub struct UpsamplerInput {
    /// Colour in [−1, 1], `[B, 3, h, w]`.
    pub colour: Tensor,
    /// Region masks, `[B, 9, h, w]`.
    pub masks: Tensor,
    /// Accumulated features, `[B, F, h, w]`.
    pub features: Tensor,
    /// Surface normals, `[B, 3, h, w]`; needed exactly when the configuration has `normal_input`.
    pub normal: Option<Tensor>,
}

/// A picture at the output resolution.
#[derive(Clone, Debug)]
pub struct UpsamplerOutput {
    /// Colour, about [−1, 1] but not clamped, `[B, 3, H, W]`.
    pub rgb: Tensor,
    /// Region masks `[B, 9, H, W]`: weights that sum to 1 from a `Residual` upsampler, raw values as in the authors'
    /// code from a `StyleGan2` one.
    pub masks: Tensor,
}

/// The noise images a `StyleGan2` upsampler adds to its layers; a `Residual` one has none and ignores it.
#[derive(Debug)]
pub enum Noise<'a> {
    /// The model's own fixed images: the same picture every time.
    Stored,
    /// These, one for each layer, `[1 or B, 1, h, w]` (a portrait's own, found by inversion).
    Given(&'a [Tensor]),
    /// Drawn anew for every picture of the batch, as in training.
    Drawn(&'a mut Stream),
    /// None at all.
    Off,
}

/// The upsampler of a generator.
#[derive(Clone, Debug)]
pub enum Upsampler {
    /// See [`residual`].
    Residual(ResidualUpsampler),
    /// See [`stylegan2`].
    StyleGan2(StyleGan2Upsampler),
}

impl Upsampler {
    /// Builds the network of `config` for a field with `field_feature_dim` feature channels and codes of `style_dim`.
    ///
    /// # Errors
    /// [`Error::Config`] when the configuration contradicts itself; [`Error::Shape`] when loaded weights do not fit.
    pub fn new(
        config: &UpsamplerConfig,
        field_feature_dim: usize,
        style_dim: usize,
        parameters: &Parameters,
    ) -> Result<Self> {
        validate(config, style_dim)?;
        Ok(match config.kind {
            UpsamplerKind::Residual => {
                Self::Residual(ResidualUpsampler::new(config, field_feature_dim, style_dim, parameters)?)
            }
            UpsamplerKind::StyleGan2 => {
                Self::StyleGan2(StyleGan2Upsampler::new(config, field_feature_dim, style_dim, parameters)?)
            }
        })
    }

    /// Lifts a render. `style` is either one code per picture, `[B, style_dim]`, or, with
    /// [`UpsamplerStyle::PerRegion`], the codes of all regions, `[B, 9, 2, style_dim]`, of which the texture rows act.
    pub fn forward(&self, input: &UpsamplerInput, style: &Tensor, noise: Noise<'_>) -> Result<UpsamplerOutput> {
        match self {
            Self::Residual(network) => network.forward(input, style),
            Self::StyleGan2(network) => network.synthesize(input, &network.latents(style)?, noise),
        }
    }
}

/// Refuses configurations that contradict themselves.
fn validate(config: &UpsamplerConfig, style_dim: usize) -> Result<()> {
    let refuse = |option: &str, reason: String| Err(Error::config(format!("upsampler.{option}"), reason));
    let (input, output) = (config.input_resolution, config.output_resolution);
    if input == 0 || output < input || output % input != 0 || !(output / input).is_power_of_two() {
        return refuse("output_resolution", format!("must be input_resolution ({input}) times a power of two"));
    }
    let resolutions = (output / input).ilog2() as usize + 1;
    if config.channels.len() != resolutions || config.channels.contains(&0) {
        return refuse(
            "channels",
            format!("needs {resolutions} positive entries, one for each resolution {input}..{output}"),
        );
    }
    if config.kind == UpsamplerKind::Residual && config.blocks.len() != resolutions {
        return refuse("blocks", format!("needs {resolutions} entries, one for each resolution {input}..{output}"));
    }
    if config.latent_dim == 0 || (config.style_layers == 0 && config.latent_dim != style_dim) {
        return refuse("latent_dim", format!("without style layers it must be the field's style_dim, {style_dim}"));
    }
    Ok(())
}

/// One code row for each region that modulates, `[B, 1 or 9, style_dim]`.
fn style_rows(style: &Tensor, kind: UpsamplerStyle, style_dim: usize) -> Result<Tensor> {
    match (style.dims(), kind) {
        (&[batch, length], _) if length == style_dim => Ok(style.reshape((batch, 1, length))?),
        (&[_, REGION_COUNT, 2, length], UpsamplerStyle::PerRegion) if length == style_dim => {
            Ok(style.narrow(2, 1, 1)?.squeeze(2)?.contiguous()?)
        }
        (found, UpsamplerStyle::PerRegion) => {
            Err(Error::shape("upsampler style", format!("[B, 9, 2, {style_dim}] or [B, {style_dim}]"), found))
        }
        (found, UpsamplerStyle::Global) => Err(Error::shape("upsampler style", format!("[B, {style_dim}]"), found)),
    }
}

/// Masks as weights: none negative, summing to 1 at every pixel (uniform where nothing is rendered), so that equal
/// codes in all regions act exactly as one global code.
pub fn region_weights(masks: &Tensor) -> Result<Tensor> {
    // Small beside any mask that matters, large enough that nine of them do not vanish in f32.
    const FLOOR: f64 = 1e-9;
    let positive = (masks.relu()? + FLOOR)?;
    Ok(positive.broadcast_div(&positive.sum_keepdim(1)?)?)
}

/// `weights` at every resolution from the input's upward; bilinear upsampling keeps their sum at 1.
fn weight_pyramid(weights: Tensor, resolutions: usize) -> Result<Vec<Tensor>> {
    let mut pyramid = vec![weights];
    while let (true, Some(last)) = (pyramid.len() < resolutions, pyramid.last()) {
        pyramid.push(Resampling::BilinearUp.apply(last)?);
    }
    Ok(pyramid)
}

/// Per-region values `[B, R, C]` at every pixel: Σ_k weight_k · value_k, `[B, C, h, w]`, or `[B, C, 1, 1]` if R = 1.
fn spread(values: &Tensor, weights: &Tensor) -> Result<Tensor> {
    let (batch, regions, channels) = values.dims3()?;
    if regions == 1 {
        return Ok(values.reshape((batch, channels, 1, 1))?);
    }
    let (_, _, height, width) = weights.dims4()?;
    let pixels = values.transpose(1, 2)?.contiguous()?.matmul(&weights.reshape((batch, regions, height * width))?)?;
    Ok(pixels.reshape((batch, channels, height, width))?)
}

#[cfg(test)]
pub(crate) mod tests {
    use candle_core::{DType, Device};

    use super::*;

    pub fn random(seed: u64, shape: &[usize]) -> Tensor {
        Stream::new(seed, &[77]).normal_tensor(shape, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
    }

    pub fn random_input(seed: u64, batch: usize, size: usize, features: usize) -> UpsamplerInput {
        UpsamplerInput {
            colour: random(seed, &[batch, 3, size, size]).tanh().unwrap(),
            masks: random(seed + 1, &[batch, 9, size, size]),
            features: random(seed + 2, &[batch, features, size, size]),
            normal: Some(random(seed + 3, &[batch, 3, size, size])),
        }
    }

    pub fn relative_error(found: &Tensor, expected: &Tensor) -> f64 {
        let norm = |tensor: &Tensor| tensor.sqr().unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap().sqrt();
        norm(&(found - expected).unwrap()) / norm(expected)
    }

    /// Compares autograd with central differences along one random direction for each tensor, in f64.
    /// Gradients of gradients jump where an activation crosses its kink: they want small steps.
    pub fn check_parameter_gradients(parameters: &Parameters, step: f64, tolerance: f64, loss: impl Fn() -> Tensor) {
        let gradients = loss().backward().unwrap();
        let value = || loss().to_scalar::<f64>().unwrap();
        let scale = value().abs();
        let mut checked = 0;
        // Stored noise is a constant that files carry: it takes no gradient by intent.
        let trained = parameters.variables().into_iter().filter(|(name, _)| !name.ends_with(".noise"));
        for (index, (name, variable)) in trained.enumerate() {
            let direction = random(1000 + index as u64, variable.dims());
            let start = variable.as_tensor().copy().unwrap();
            let moved = |step: f64| {
                variable.set(&(&start + (&direction * step).unwrap()).unwrap()).unwrap();
                value()
            };
            let difference = (moved(step) - moved(-step)) / (2.0 * step);
            variable.set(&start).unwrap();
            let automatic = match gradients.get(&variable) {
                Some(gradient) => (gradient * &direction).unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap(),
                None => 0.0,
            };
            checked += usize::from(difference != 0.0);
            let error = (automatic - difference).abs() / (difference.abs() + 1e-3 * scale);
            assert!(error < tolerance, "{name}: autograd {automatic}, finite difference {difference}");
        }
        assert!(checked > 0, "no parameter moved the loss");
    }
}
