//! The recipe's upsampler: residual blocks at the render's and every higher resolution, region-weighted modulation in
//! each, the result added to the bilinear colour. Trained on pairs of renders and photos.
//!
//! Upsampling is bilinear followed by a 3×3 convolution; the pixel shuffle of the first experiment left stripes.

use candle_core::Tensor;

use super::{UpsamplerInput, UpsamplerOutput, region_weights, spread, style_rows, weight_pyramid};
use crate::{
    config::{UpsamplerConfig, UpsamplerStyle},
    error::{Error, Result},
    kernels::activation::{modulated_silu, silu},
    model::layers::{Convolution, Resampling, StyleNetwork, linear},
    parameters::{Init, Parameters},
    region::REGION_COUNT,
};

/// See the [module](self).
#[derive(Clone, Debug)]
pub struct ResidualUpsampler {
    style: UpsamplerStyle,
    style_dim: usize,
    normal_input: bool,
    style_network: StyleNetwork,
    first: Convolution,
    levels: Vec<Level>,
    last: Convolution,
}

/// The blocks of one resolution, after the step up to it.
#[derive(Clone, Debug)]
struct Level {
    step_up: Option<StepUp>,
    blocks: Vec<Block>,
}

/// Doubles the resolution. Channels change before the picture grows: 1×1 and bilinear commute, and it is cheaper so.
#[derive(Clone, Debug)]
struct StepUp {
    channels: Convolution,
    sharpen: Convolution,
}

/// x + conv(silu(modulate(conv(silu(x))))).
#[derive(Clone, Debug)]
struct Block {
    first: Convolution,
    modulation_weight: Tensor,
    modulation_bias: Tensor,
    second: Convolution,
}

impl ResidualUpsampler {
    pub(super) fn new(
        config: &UpsamplerConfig,
        field_feature_dim: usize,
        style_dim: usize,
        parameters: &Parameters,
    ) -> Result<Self> {
        let inputs = 3 + REGION_COUNT + field_feature_dim + if config.normal_input { 3 } else { 0 };
        let (mut levels, mut channels) = (Vec::new(), None);
        for (index, (&width, &blocks)) in config.channels.iter().zip(&config.blocks).enumerate() {
            let parameters = parameters.within(format_args!("level.{index}"));
            let step_up = match channels {
                None => None,
                Some(before) => Some(StepUp {
                    channels: Convolution::new(before, width, 1, 1.0, &parameters.within("channels"))?,
                    sharpen: Convolution::new(width, width, 3, 1.0, &parameters.within("sharpen"))?,
                }),
            };
            let block = |index| Block::new(width, config.latent_dim, &parameters.within(format_args!("block.{index}")));
            levels.push(Level { step_up, blocks: (0..blocks).map(block).collect::<Result<_>>()? });
            channels = Some(width);
        }
        let (Some(&narrowest), Some(&widest)) = (config.channels.first(), config.channels.last()) else {
            return Err(Error::config("upsampler.channels", "must not be empty"));
        };
        Ok(Self {
            style: config.style,
            style_dim,
            normal_input: config.normal_input,
            style_network: StyleNetwork::new(
                style_dim,
                config.latent_dim,
                config.style_layers,
                &parameters.within("style"),
            )?,
            first: Convolution::new(inputs, narrowest, 3, 1.0, &parameters.within("first"))?,
            levels,
            // A tenth of the usual start: the first pictures are the bilinear ones.
            last: Convolution::new(widest, 3, 3, 0.1, &parameters.within("last"))?,
        })
    }

    pub(super) fn forward(&self, input: &UpsamplerInput, style: &Tensor) -> Result<UpsamplerOutput> {
        let style = self.style_network.forward(&style_rows(style, self.style, self.style_dim)?)?;
        let mut masks = region_weights(&input.masks)?;
        let pyramid = weight_pyramid(masks.clone(), self.levels.len())?;
        let mut hidden = self.first.forward(&self.stack(input, &masks)?)?;
        let mut colour = input.colour.clone();
        for (level, weights) in self.levels.iter().zip(pyramid) {
            if let Some(step_up) = &level.step_up {
                let coarse = step_up.channels.forward(&hidden)?;
                hidden = step_up.sharpen.forward(&Resampling::BilinearUp.apply(&coarse)?)?;
                colour = Resampling::BilinearUp.apply(&colour)?;
            }
            for block in &level.blocks {
                hidden = block.forward(&hidden, &style, &weights)?;
            }
            masks = weights;
        }
        let rgb = (colour + self.last.forward(&silu(&hidden)?)?)?;
        Ok(UpsamplerOutput { rgb, masks })
    }

    /// All inputs as channels of one picture.
    fn stack(&self, input: &UpsamplerInput, weights: &Tensor) -> Result<Tensor> {
        let mut channels = vec![&input.colour, weights, &input.features];
        match (&input.normal, self.normal_input) {
            (Some(normal), true) => channels.push(normal),
            (None, true) => {
                return Err(Error::config("upsampler.normal_input", "this model needs the render's normals as input"));
            }
            (_, false) => {}
        }
        Ok(Tensor::cat(&channels, 1)?)
    }
}

impl Block {
    fn new(channels: usize, latent_dim: usize, parameters: &Parameters) -> Result<Self> {
        let modulation = parameters.within("modulation");
        let deviation = 0.25 / (latent_dim as f64).sqrt();
        Ok(Self {
            first: Convolution::new(channels, channels, 3, 1.0, &parameters.within("first"))?,
            modulation_weight: modulation.get("weight", &[2 * channels, latent_dim], Init::Normal(deviation))?,
            modulation_bias: modulation.get("bias", &[2 * channels], Init::Constant(0.0))?,
            // Blocks start close to the identity.
            second: Convolution::new(channels, channels, 3, 0.3, &parameters.within("second"))?,
        })
    }

    fn forward(&self, input: &Tensor, style: &Tensor, weights: &Tensor) -> Result<Tensor> {
        let hidden = self.first.forward(&silu(input)?)?;
        let modulation = linear(style, &self.modulation_weight)?.broadcast_add(&self.modulation_bias)?;
        let modulated = modulated_silu(&hidden, &spread(&modulation, weights)?)?;
        Ok((input + self.second.forward(&modulated)?)?)
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::super::{Noise, Upsampler};
    use super::*;
    use crate::{codes, model::upsampler::tests::*};

    fn config() -> UpsamplerConfig {
        UpsamplerConfig {
            input_resolution: 8,
            output_resolution: 32,
            channels: vec![6, 5, 4],
            blocks: vec![1, 2, 1],
            ..UpsamplerConfig::ours(7)
        }
    }

    fn build(config: &UpsamplerConfig) -> (Upsampler, Parameters) {
        let parameters = Parameters::fresh(3, DType::F64, &Device::Cpu);
        (Upsampler::new(config, 5, 7, &parameters).unwrap(), parameters)
    }

    #[test]
    fn starts_near_the_bilinear_colour_and_keeps_a_partition_of_unity() {
        let (network, _) = build(&config());
        let input = random_input(1, 2, 8, 5);
        let output = network.forward(&input, &random(2, &[2, 9, 2, 7]), Noise::Off).unwrap();
        assert_eq!((output.rgb.dims(), output.masks.dims()), (&[2, 3, 32, 32][..], &[2, 9, 32, 32][..]));
        let sums = output.masks.sum(1).unwrap().flatten_all().unwrap().to_vec1::<f64>().unwrap();
        assert!(sums.iter().all(|sum| (sum - 1.0).abs() < 1e-12));
        let twice = Resampling::BilinearUp.apply(&Resampling::BilinearUp.apply(&input.colour).unwrap()).unwrap();
        let error = relative_error(&output.rgb, &twice);
        assert!(error > 0.0 && error < 0.3, "{error}");
    }

    #[test]
    fn crops_of_any_size_pass() {
        let (network, _) = build(&config());
        let output = network.forward(&random_input(1, 1, 6, 5), &random(2, &[1, 7]), Noise::Off).unwrap();
        assert_eq!(output.rgb.dims(), [1, 3, 24, 24]);
    }

    #[test]
    fn equal_codes_in_all_regions_act_as_one_global_code() {
        let (per_region, parameters) = build(&config());
        let global = UpsamplerConfig { style: UpsamplerStyle::Global, ..config() };
        let global = Upsampler::new(&global, 5, 7, &parameters).unwrap();
        let (input, code) = (random_input(1, 2, 8, 5), random(2, &[2, 7]));
        let left = per_region.forward(&input, &codes::broadcast(&code).unwrap(), Noise::Off).unwrap();
        let right = global.forward(&input, &code, Noise::Off).unwrap();
        assert!(relative_error(&left.rgb, &right.rgb) < 1e-12);
        assert!(global.forward(&input, &codes::broadcast(&code).unwrap(), Noise::Off).is_err());
    }

    #[test]
    fn shape_rows_do_not_act() {
        let (network, _) = build(&config());
        let (input, codes) = (random_input(1, 1, 8, 5), random(2, &[1, 9, 2, 7]));
        let texture_only =
            codes::blend(&codes, &random(3, &[1, 9, 2, 7]), crate::region::RegionSet::ALL, codes::Aspect::Shape, 1.0)
                .unwrap();
        let left = network.forward(&input, &codes, Noise::Off).unwrap();
        let right = network.forward(&input, &texture_only, Noise::Off).unwrap();
        assert_eq!(relative_error(&left.rgb, &right.rgb), 0.0);
    }

    #[test]
    fn gradients_match_finite_differences() {
        let (network, parameters) = build(&config());
        let (input, codes) = (random_input(1, 2, 8, 5), random(2, &[2, 9, 2, 7]));
        let target = random(4, &[2, 3, 32, 32]);
        check_parameter_gradients(&parameters, 1e-5, 1e-6, || {
            let output = network.forward(&input, &codes, Noise::Off).unwrap();
            (output.rgb - &target).unwrap().sqr().unwrap().mean_all().unwrap()
        });
    }

    #[test]
    fn missing_normals_are_an_error_that_says_so() {
        let (network, _) = build(&config());
        let input = UpsamplerInput { normal: None, ..random_input(1, 1, 8, 5) };
        let error = network.forward(&input, &random(2, &[1, 7]), Noise::Off).unwrap_err();
        assert!(error.to_string().contains("normals"), "{error}");
    }
}
