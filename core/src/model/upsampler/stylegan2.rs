//! The paper's upsampler: StyleGAN2 on a feature map, with a picture branch and a mask branch.
//!
//! Structure and indices follow the authors' code. Convolutions are modulated by scaling their input and demodulated by
//! scaling their output, which equals scaling the weights when one code drives the picture and carries over to a code
//! per pixel. Layer i reads latent i; the picture and mask outputs of level l read latent 2l + 1; the rendered masks are
//! the first mask skip, while the rendered colour is not used.
//!
//! [`StyleGan2Upsampler::latent_gradient`] is the hand-written gradient of the picture with respect to the latents; it
//! is differentiable, which is what path-length regularisation needs.

use candle_core::Tensor;

use super::{Noise, UpsamplerInput, UpsamplerOutput, region_weights, spread, style_rows, weight_pyramid};
use crate::{
    config::{UpsamplerConfig, UpsamplerStyle},
    error::{Error, Result},
    model::layers::{
        EqualConvolution, EqualLinear, Resampling, StyleNetwork, add_bias, convolve, convolve_adjoint, leaky_slope,
        linear,
    },
    parameters::{Init, Parameters},
    region::REGION_COUNT,
};

/// See the [module](self).
#[derive(Clone, Debug)]
pub struct StyleGan2Upsampler {
    style: UpsamplerStyle,
    style_dim: usize,
    style_network: StyleNetwork,
    feature_transfer: EqualConvolution,
    layers: Vec<StyledLayer>,
    to_rgb: Vec<ToPicture>,
    to_masks: Vec<ToPicture>,
}

/// What [`StyleGan2Upsampler::latent_gradient`] needs of a forward pass.
#[derive(Debug)]
pub struct SynthesisTrace {
    weights: Vec<Tensor>,
    layers: Vec<LayerTrace>,
    to_rgb: Vec<ModulationTrace>,
}

impl StyleGan2Upsampler {
    pub(super) fn new(
        config: &UpsamplerConfig,
        field_feature_dim: usize,
        style_dim: usize,
        parameters: &Parameters,
    ) -> Result<Self> {
        let Some(&narrowest) = config.channels.first() else {
            return Err(Error::config("upsampler.channels", "must not be empty"));
        };
        // The authors' 256 feature channels for 512 at the input's resolution.
        let feature_channels = narrowest.div_ceil(2);
        let latent_dim = config.latent_dim;
        let (mut layers, mut to_rgb, mut to_masks) = (Vec::new(), Vec::new(), Vec::new());
        let mut inputs = feature_channels;
        for (level, &outputs) in config.channels.iter().enumerate() {
            let resolution = config.input_resolution << level;
            let mut push = |inputs, upsampling| -> Result<()> {
                let parameters = parameters.within(format_args!("layer.{}", layers.len()));
                layers.push(StyledLayer::new([inputs, outputs], latent_dim, upsampling, resolution, &parameters)?);
                Ok(())
            };
            push(inputs, level > 0)?;
            if level > 0 {
                push(outputs, false)?;
            }
            let picture = |name, channels| {
                ToPicture::new(outputs, channels, latent_dim, &parameters.within(format_args!("{name}.{level}")))
            };
            to_rgb.push(picture("to_rgb", 3)?);
            to_masks.push(picture("to_masks", REGION_COUNT)?);
            inputs = outputs;
        }
        Ok(Self {
            style: config.style,
            style_dim,
            style_network: StyleNetwork::new(style_dim, latent_dim, config.style_layers, &parameters.within("style"))?,
            feature_transfer: EqualConvolution::new(
                field_feature_dim,
                feature_channels,
                3,
                &parameters.within("feature_transfer"),
            )?,
            layers,
            to_rgb,
            to_masks,
        })
    }

    /// Number of latents a picture takes.
    pub fn latent_count(&self) -> usize {
        self.layers.len() + 1
    }

    /// The style network's latents of a code, `[B, style_dim]` or `[B, 9, 2, style_dim]`: the same for every layer, each
    /// `[B, R, latent_dim]` with R = 1 for one global code and 9 for a code per region. [`crate::codes::truncate`]
    /// pulls them towards their mean `[latent_dim]`.
    pub fn latents(&self, style: &Tensor) -> Result<Vec<Tensor>> {
        let latent = self.style_network.forward(&style_rows(style, self.style, self.style_dim)?)?;
        Ok(vec![latent; self.latent_count()])
    }

    /// Style mixing: `first` before layer `inject_index`, `second` from there on.
    pub fn mix(first: &[Tensor], second: &[Tensor], inject_index: usize) -> Vec<Tensor> {
        first.iter().take(inject_index).chain(second.iter().skip(inject_index)).cloned().collect()
    }

    /// The features after the first, unmodulated convolution, `[B, channels, h, w]`.
    pub fn transfer_features(&self, features: &Tensor) -> Result<Tensor> {
        self.feature_transfer.forward(features)
    }

    /// The picture of `input` under one latent for each of [`Self::latent_count`] places.
    pub fn synthesize(&self, input: &UpsamplerInput, latents: &[Tensor], noise: Noise<'_>) -> Result<UpsamplerOutput> {
        let features = self.transfer_features(&input.features)?;
        Ok(self.synthesize_from(&features, &input.masks, latents, noise)?.0)
    }

    /// As [`Self::synthesize`] from features that are already transferred, with the trace of the pass.
    pub fn synthesize_from(
        &self,
        features: &Tensor,
        masks: &Tensor,
        latents: &[Tensor],
        mut noise: Noise<'_>,
    ) -> Result<(UpsamplerOutput, SynthesisTrace)> {
        let Some(regions) = latents.first().map(|latent| latent.dim(1)).transpose()? else {
            return Err(Error::shape("upsampler latents", format!("{} tensors", self.latent_count()), &[0]));
        };
        if latents.len() != self.latent_count() {
            let expected = format!("{} tensors", self.latent_count());
            return Err(Error::shape("upsampler latents", expected, &[latents.len()]));
        }
        let levels = self.to_rgb.len();
        let weights = match regions {
            1 => vec![masks.clone(); levels],
            _ => weight_pyramid(region_weights(masks)?, levels)?,
        };
        let mut trace = SynthesisTrace { weights, layers: Vec::new(), to_rgb: Vec::new() };
        let (mut hidden, mut rgb, mut segmentation) = (features.clone(), None, masks.clone());
        let pictures = self.to_rgb.iter().zip(&self.to_masks);
        for (level, ((to_rgb, to_masks), weights)) in pictures.zip(&trace.weights).enumerate() {
            let here = if level == 0 { 0..1 } else { 2 * level - 1..2 * level + 1 };
            for ((index, layer), latent) in
                self.layers.iter().enumerate().zip(latents).skip(here.start).take(here.len())
            {
                let coarse = trace.weights.get(level.saturating_sub(1)).filter(|_| layer.upsamples());
                let masks = RegionMasks { coarse: coarse.unwrap_or(weights), fine: weights };
                let (output, record) = layer.forward(&hidden, latent, masks, index, &mut noise)?;
                hidden = output;
                trace.layers.push(record);
            }
            let Some(latent) = latents.get(2 * level + 1) else { break };
            let (picture, record) = to_rgb.forward(&hidden, latent, weights)?;
            trace.to_rgb.push(record);
            rgb = Some(match rgb {
                Some(coarse) => (Resampling::FIR_UP.apply(&coarse)? + picture)?,
                None => picture,
            });
            let (picture, _) = to_masks.forward(&hidden, latent, weights)?;
            let coarse = if level == 0 { segmentation } else { Resampling::FIR_UP.apply(&segmentation)? };
            segmentation = (coarse + picture)?;
        }
        let rgb = rgb.ok_or_else(|| Error::config("upsampler.channels", "must not be empty"))?;
        Ok((UpsamplerOutput { rgb, masks: segmentation }, trace))
    }

    /// The gradient of Σ rgb · `rgb_gradient` with respect to every latent, as differentiable tensors of the latents'
    /// shapes. `rgb_gradient` `[B, 3, H, W]` is a constant.
    pub fn latent_gradient(&self, trace: &SynthesisTrace, rgb_gradient: &Tensor) -> Result<Vec<Tensor>> {
        let mut gradients: Vec<Option<Tensor>> = vec![None; self.latent_count()];
        let mut add = |index: usize, gradient: Tensor| -> Result<()> {
            if let Some(slot) = gradients.get_mut(index) {
                *slot = Some(match slot.take() {
                    Some(sum) => (sum + gradient)?,
                    None => gradient,
                });
            }
            Ok(())
        };
        let (mut rgb_gradient, mut hidden_gradient): (Tensor, Option<Tensor>) = (rgb_gradient.clone(), None);
        let mut layers = self.layers.iter().zip(&trace.layers).enumerate().rev();
        let pictures = self.to_rgb.iter().zip(&trace.to_rgb).zip(&trace.weights).enumerate().rev();
        for (level, ((to_rgb, record), weights)) in pictures {
            let (through_picture, latent) = to_rgb.convolution.adjoint(&rgb_gradient, record, weights, weights)?;
            add(2 * level + 1, latent)?;
            let mut gradient = match hidden_gradient.take() {
                Some(from_above) => (from_above + through_picture)?,
                None => through_picture,
            };
            for (index, (layer, record)) in layers.by_ref().take(if level == 0 { 1 } else { 2 }) {
                let coarse = trace.weights.get(level.saturating_sub(1)).filter(|_| layer.upsamples());
                let masks = RegionMasks { coarse: coarse.unwrap_or(weights), fine: weights };
                let (input, latent) = layer.adjoint(&gradient, record, masks)?;
                add(index, latent)?;
                gradient = input;
            }
            hidden_gradient = Some(gradient);
            if level > 0 {
                let (_, _, height, width) = rgb_gradient.dims4()?;
                rgb_gradient = Resampling::FIR_UP.adjoint(&rgb_gradient, (height / 2, width / 2))?;
            }
        }
        let missing = || Error::shape("synthesis trace", "a trace of this network", &[trace.layers.len()]);
        gradients.into_iter().map(|gradient| gradient.ok_or_else(missing)).collect()
    }
}

/// Region weights at a convolution's input and output resolution; read only when codes differ by region.
#[derive(Clone, Copy)]
struct RegionMasks<'a> {
    coarse: &'a Tensor,
    fine: &'a Tensor,
}

/// Modulated convolution, noise, bias, leaky ReLU × √2.
#[derive(Clone, Debug)]
struct StyledLayer {
    convolution: ModulatedConvolution,
    noise_strength: Tensor,
    stored_noise: Tensor,
    bias: Tensor,
}

#[derive(Debug)]
struct LayerTrace {
    convolution: ModulationTrace,
    slope: Tensor,
}

impl StyledLayer {
    fn new(
        [inputs, outputs]: [usize; 2],
        latent_dim: usize,
        upsampling: bool,
        resolution: usize,
        parameters: &Parameters,
    ) -> Result<Self> {
        let kind = if upsampling { ConvolutionKind::Upsampling } else { ConvolutionKind::Plain };
        Ok(Self {
            convolution: ModulatedConvolution::new([inputs, outputs], kind, latent_dim, parameters)?,
            noise_strength: parameters.get("noise_strength", &[1], Init::Constant(0.0))?,
            // Kept beside the weights so that files carry it, detached so that no optimiser moves it.
            stored_noise: parameters.get("noise", &[1, 1, resolution, resolution], Init::Normal(1.0))?.detach(),
            bias: parameters.get("bias", &[outputs], Init::Constant(0.0))?,
        })
    }

    fn upsamples(&self) -> bool {
        self.convolution.kind == ConvolutionKind::Upsampling
    }

    fn forward(
        &self,
        input: &Tensor,
        latent: &Tensor,
        masks: RegionMasks<'_>,
        index: usize,
        noise: &mut Noise<'_>,
    ) -> Result<(Tensor, LayerTrace)> {
        let (mut output, convolution) = self.convolution.forward(input, latent, masks.coarse, masks.fine)?;
        if let Some(noise) = self.noise(&output, index, noise)? {
            output = output.broadcast_add(&noise.broadcast_mul(&self.noise_strength)?)?;
        }
        let output = add_bias(&output, &self.bias)?;
        let slope = (leaky_slope(&output)? * std::f64::consts::SQRT_2)?;
        Ok(((output * &slope)?, LayerTrace { convolution, slope }))
    }

    /// The noise image for an output like `output`, `[1 or B, 1, h, w]`.
    fn noise(&self, output: &Tensor, index: usize, noise: &mut Noise<'_>) -> Result<Option<Tensor>> {
        let (batch, _, height, width) = output.dims4()?;
        let image = match noise {
            Noise::Off => return Ok(None),
            Noise::Stored => self.stored_noise.clone(),
            Noise::Given(images) => {
                let expected = format!("one image for each layer, at least {}", index + 1);
                images.get(index).ok_or_else(|| Error::shape("upsampler noise", expected, &[images.len()]))?.clone()
            }
            Noise::Drawn(stream) => {
                stream.normal_tensor(&[batch, 1, height, width], output.device())?.to_dtype(output.dtype())?
            }
        };
        match *image.dims() {
            [images, 1, h, w] if (h, w) == (height, width) && (images == 1 || images == batch) => Ok(Some(image)),
            _ => Err(Error::shape("upsampler noise", [batch, 1, height, width], image.dims())),
        }
    }

    /// Gradients of the input and of the latent.
    fn adjoint(&self, gradient: &Tensor, trace: &LayerTrace, masks: RegionMasks<'_>) -> Result<(Tensor, Tensor)> {
        let gradient = (gradient * &trace.slope)?;
        self.convolution.adjoint(&gradient, &trace.convolution, masks.coarse, masks.fine)
    }
}

/// A modulated 1×1 convolution without demodulation, and a bias: hidden channels to colour or masks.
#[derive(Clone, Debug)]
struct ToPicture {
    convolution: ModulatedConvolution,
    bias: Tensor,
}

impl ToPicture {
    fn new(inputs: usize, outputs: usize, latent_dim: usize, parameters: &Parameters) -> Result<Self> {
        Ok(Self {
            convolution: ModulatedConvolution::new(
                [inputs, outputs],
                ConvolutionKind::Picture,
                latent_dim,
                parameters,
            )?,
            bias: parameters.get("bias", &[outputs], Init::Constant(0.0))?,
        })
    }

    fn forward(&self, input: &Tensor, latent: &Tensor, weights: &Tensor) -> Result<(Tensor, ModulationTrace)> {
        let (output, trace) = self.convolution.forward(input, latent, weights, weights)?;
        Ok((add_bias(&output, &self.bias)?, trace))
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ConvolutionKind {
    /// 3×3, demodulated.
    Plain,
    /// 3×3 transposed with stride 2, FIR blur, demodulated.
    Upsampling,
    /// 1×1, not demodulated.
    Picture,
}

/// y = D · conv(S · x), with S = A w + b at every input channel and D_o = (Σ (weight · S)² + 1e-8)^(−1/2) at every
/// output channel, both spread over the pixels by region weights when codes differ by region.
#[derive(Clone, Debug)]
struct ModulatedConvolution {
    weight: Tensor,
    modulation: EqualLinear,
    kind: ConvolutionKind,
}

#[derive(Debug)]
struct ModulationTrace {
    input: Tensor,
    style: Tensor,
    spread_style: Tensor,
    demodulation: Option<DemodulationTrace>,
}

#[derive(Debug)]
struct DemodulationTrace {
    /// Before demodulation.
    convolved: Tensor,
    /// Squared weights summed over the kernel, `[O, I]`.
    power: Tensor,
    coefficient: Tensor,
    spread_coefficient: Tensor,
}

impl ModulatedConvolution {
    fn new(
        [inputs, outputs]: [usize; 2],
        kind: ConvolutionKind,
        latent_dim: usize,
        parameters: &Parameters,
    ) -> Result<Self> {
        let kernel = if kind == ConvolutionKind::Picture { 1 } else { 3 };
        Ok(Self {
            weight: parameters.get("weight", &[outputs, inputs, kernel, kernel], Init::Normal(1.0))?,
            modulation: EqualLinear::new(latent_dim, inputs, 1.0, 1.0, false, &parameters.within("modulation"))?,
            kind,
        })
    }

    /// The weight as it acts: `[O, I, k, k]`.
    fn scaled_weight(&self) -> Result<Tensor> {
        let (_, inputs, kernel, _) = self.weight.dims4()?;
        Ok((&self.weight / ((inputs * kernel * kernel) as f64).sqrt())?)
    }

    /// `input` `[B, I, h, w]`, `latent` `[B, R, L]`; region weights at the input's and the output's resolution.
    fn forward(
        &self,
        input: &Tensor,
        latent: &Tensor,
        coarse: &Tensor,
        fine: &Tensor,
    ) -> Result<(Tensor, ModulationTrace)> {
        let style = self.modulation.forward(latent)?;
        let spread_style = spread(&style, coarse)?;
        let weight = self.scaled_weight()?;
        let convolved = self.convolve(&input.broadcast_mul(&spread_style)?, &weight)?;
        let mut trace = ModulationTrace { input: input.clone(), style, spread_style, demodulation: None };
        if self.kind == ConvolutionKind::Picture {
            return Ok((convolved, trace));
        }
        let power = weight.sqr()?.sum((2, 3))?;
        let coefficient = (linear(&trace.style.sqr()?, &power)? + 1e-8)?.sqrt()?.recip()?;
        let spread_coefficient = spread(&coefficient, fine)?;
        let output = convolved.broadcast_mul(&spread_coefficient)?;
        trace.demodulation = Some(DemodulationTrace { convolved, power, coefficient, spread_coefficient });
        Ok((output, trace))
    }

    /// Gradients of the input `[B, I, h, w]` and of the latent `[B, R, L]`.
    fn adjoint(
        &self,
        gradient: &Tensor,
        trace: &ModulationTrace,
        coarse: &Tensor,
        fine: &Tensor,
    ) -> Result<(Tensor, Tensor)> {
        let regions = trace.style.dim(1)?;
        let mut style_gradient = None;
        let mut gradient = gradient.clone();
        if let Some(DemodulationTrace { convolved, power, coefficient, spread_coefficient }) = &trace.demodulation {
            let coefficient_gradient = gather(&(&gradient * convolved)?, fine, regions)?;
            // dD/d(sum) = −D³/2, d(sum)/ds = 2 s · power.
            let sum_gradient = (coefficient_gradient * (coefficient.sqr()? * coefficient)?)?;
            style_gradient = Some((linear(&sum_gradient, &power.t()?)? * &trace.style)?.neg()?);
            gradient = gradient.broadcast_mul(spread_coefficient)?;
        }
        let (_, _, height, width) = trace.input.dims4()?;
        let scaled = self.convolve_adjoint(&gradient, &self.scaled_weight()?, (height, width))?;
        let direct = gather(&(&scaled * &trace.input)?, coarse, regions)?;
        let style_gradient = match style_gradient {
            Some(through_demodulation) => (through_demodulation + direct)?,
            None => direct,
        };
        let latent_gradient = linear(&style_gradient, &self.modulation.scaled_weight()?.t()?)?;
        Ok((scaled.broadcast_mul(&trace.spread_style)?, latent_gradient))
    }

    fn convolve(&self, input: &Tensor, weight: &Tensor) -> Result<Tensor> {
        match self.kind {
            ConvolutionKind::Plain => convolve(input, weight, None, 1, 1),
            ConvolutionKind::Picture => convolve(input, weight, None, 1, 0),
            ConvolutionKind::Upsampling => {
                let (_, _, height, width) = input.dims4()?;
                let weight = weight.transpose(0, 1)?.contiguous()?;
                let raw = convolve_adjoint(input, &weight, 2, 0, (2 * height + 1, 2 * width + 1))?;
                Resampling::BLUR_AFTER_UP.apply(&raw)
            }
        }
    }

    fn convolve_adjoint(&self, gradient: &Tensor, weight: &Tensor, size: (usize, usize)) -> Result<Tensor> {
        match self.kind {
            ConvolutionKind::Plain => convolve_adjoint(gradient, weight, 1, 1, size),
            ConvolutionKind::Picture => convolve_adjoint(gradient, weight, 1, 0, size),
            ConvolutionKind::Upsampling => {
                let blurred = Resampling::BLUR_AFTER_UP.adjoint(gradient, (2 * size.0 + 1, 2 * size.1 + 1))?;
                convolve(&blurred, &weight.transpose(0, 1)?.contiguous()?, None, 2, 0)
            }
        }
    }
}

/// The adjoint of [`spread`]: per-pixel gradients `[B, C, h, w]` to per-region ones, `[B, R, C]`.
fn gather(gradient: &Tensor, weights: &Tensor, regions: usize) -> Result<Tensor> {
    let (batch, channels, height, width) = gradient.dims4()?;
    if regions == 1 {
        return Ok(gradient.sum((2, 3))?.reshape((batch, 1, channels))?);
    }
    let weights = weights.reshape((batch, regions, height * width))?;
    let pixels = gradient.reshape((batch, channels, height * width))?.transpose(1, 2)?.contiguous()?;
    Ok(weights.matmul(&pixels)?)
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::{
        codes,
        model::upsampler::{Upsampler, tests::*},
        rng::Stream,
        train::adversarial::PathLength,
    };

    fn config(style: UpsamplerStyle) -> UpsamplerConfig {
        UpsamplerConfig {
            style,
            input_resolution: 8,
            output_resolution: 16,
            channels: vec![6, 4],
            style_layers: 2,
            latent_dim: 5,
            ..UpsamplerConfig::paper(7)
        }
    }

    fn build(style: UpsamplerStyle) -> (StyleGan2Upsampler, Parameters) {
        let parameters = Parameters::fresh(3, candle_core::DType::F64, &Device::Cpu);
        let Upsampler::StyleGan2(network) = Upsampler::new(&config(style), 5, 7, &parameters).unwrap() else {
            panic!("asked for StyleGAN2");
        };
        for (name, variable) in parameters.variables() {
            if name.ends_with("noise_strength") {
                variable.set(&random(9, &[1])).unwrap();
            }
        }
        (network, parameters)
    }

    #[test]
    fn equal_codes_in_all_regions_act_as_one_global_code() {
        let (per_region, _) = build(UpsamplerStyle::PerRegion);
        let (global, _) = build(UpsamplerStyle::Global);
        let (input, code) = (random_input(1, 2, 8, 5), random(2, &[2, 7]));
        let regions = per_region.latents(&codes::broadcast(&code).unwrap()).unwrap();
        assert_eq!(regions[0].dims(), [2, 9, 5]);
        let left = per_region.synthesize(&input, &regions, Noise::Stored).unwrap();
        let right = global.synthesize(&input, &global.latents(&code).unwrap(), Noise::Stored).unwrap();
        assert!(relative_error(&left.rgb, &right.rgb) < 1e-12);
        assert!(relative_error(&left.masks, &right.masks) < 1e-12);
    }

    #[test]
    fn noise_acts_as_asked() {
        let (network, _) = build(UpsamplerStyle::Global);
        let (input, latents) = (random_input(1, 1, 8, 5), network.latents(&random(2, &[1, 7])).unwrap());
        let picture = |noise: Noise<'_>| network.synthesize(&input, &latents, noise).unwrap().rgb;
        let stored = picture(Noise::Stored);
        assert_eq!(relative_error(&picture(Noise::Stored), &stored), 0.0);
        assert!(relative_error(&picture(Noise::Off), &stored) > 1e-3);
        assert!(relative_error(&picture(Noise::Drawn(&mut Stream::new(1, &[]))), &stored) > 1e-3);
        let own: Vec<Tensor> = network.layers.iter().map(|layer| layer.stored_noise.clone()).collect();
        assert_eq!(relative_error(&picture(Noise::Given(&own)), &stored), 0.0);
        assert!(network.synthesize(&input, &latents, Noise::Given(&own[1..])).is_err());
    }

    #[test]
    fn gradients_match_finite_differences() {
        for style in [UpsamplerStyle::Global, UpsamplerStyle::PerRegion] {
            let (network, parameters) = build(style);
            let input = random_input(1, 2, 8, 5);
            let code = if style == UpsamplerStyle::Global { random(2, &[2, 7]) } else { random(2, &[2, 9, 2, 7]) };
            check_parameter_gradients(&parameters, 1e-6, 1e-5, || {
                let latents = network.latents(&code).unwrap();
                let output = network.synthesize(&input, &latents, Noise::Stored).unwrap();
                (output.rgb.sqr().unwrap().mean_all().unwrap() + output.masks.powf(3.0).unwrap().mean_all().unwrap())
                    .unwrap()
            });
        }
    }

    #[test]
    fn the_latent_gradient_is_autograd_s_and_its_own_gradient_is_exact() {
        for style in [UpsamplerStyle::Global, UpsamplerStyle::PerRegion] {
            let (network, parameters) = build(style);
            let input = random_input(1, 2, 8, 5);
            let code = if style == UpsamplerStyle::Global { random(2, &[2, 7]) } else { random(2, &[2, 9, 2, 7]) };
            let noise = random(5, &[2, 3, 16, 16]);

            let latents: Vec<_> = network
                .latents(&code)
                .unwrap()
                .iter()
                .map(|latent| candle_core::Var::from_tensor(&latent.detach()).unwrap())
                .collect();
            let tensors: Vec<Tensor> = latents.iter().map(|latent| latent.as_tensor().clone()).collect();
            let features = network.transfer_features(&input.features).unwrap();
            let (output, trace) = network.synthesize_from(&features, &input.masks, &tensors, Noise::Stored).unwrap();
            let explicit = network.latent_gradient(&trace, &noise).unwrap();
            let automatic = (output.rgb * &noise).unwrap().sum_all().unwrap().backward().unwrap();
            for (latent, explicit) in latents.iter().zip(&explicit) {
                assert!(relative_error(explicit, automatic.get(latent).unwrap()) < 1e-12);
            }

            let previous_mean = Tensor::new(0.3f64, &Device::Cpu).unwrap();
            check_parameter_gradients(&parameters, 1e-7, 1e-4, || {
                let latents = network.latents(&code).unwrap();
                let features = network.transfer_features(&input.features).unwrap();
                let traced = network.synthesize_from(&features, &input.masks, &latents, Noise::Stored).unwrap();
                let gradient = network.latent_gradient(&traced.1, &noise).unwrap();
                PathLength::new(&gradient, &previous_mean, 0.01).unwrap().penalty
            });
        }
    }
}
