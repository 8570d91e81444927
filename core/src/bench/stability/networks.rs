//! Stress on what surrounds the field: aggregation along rays, losses, norms, discriminators with their R1 penalty, and
//! the upsamplers.

use candle_core::{DType, Device, Tensor};

use super::{Case, Inputs, Outputs, fresh};
use crate::{
    config::{UpsamplerConfig, UpsamplerKind},
    error::Result,
    model::{
        discriminator::{Discriminator, DiscriminatorConfig, DiscriminatorKind},
        file::Tensors,
        layers::pixel_norm,
        upsampler::{Noise, Upsampler, UpsamplerInput},
    },
    region::REGION_COUNT,
    render::{RayWeights, norm},
    train::{
        adversarial::{self, PathLength},
        losses,
    },
};

pub(super) fn cases() -> Vec<Case> {
    let mut cases = rays();
    cases.extend(loss_terms());
    for kind in [DiscriminatorKind::Global, DiscriminatorKind::Semantic, DiscriminatorKind::HighResolution] {
        cases.push(Judge { kind, batch: 1, weights: 1.0, pictures: 1.0 }.case(format!("R1: {kind:?}, batch 1")));
        cases.push(
            Judge { kind, batch: 2, weights: 0.0, pictures: 1.0 }.case(format!("R1: {kind:?}, gradient exactly zero")),
        );
    }
    let judge = Judge { kind: DiscriminatorKind::Global, batch: 3, weights: 1.0, pictures: 0.0 };
    cases.push(judge.case("R1: pictures all grey"));
    let judge = Judge { kind: DiscriminatorKind::Global, batch: 2, weights: 1.0, pictures: 1e4 };
    cases.push(judge.case("R1: pictures of ±1e4"));
    for kind in [UpsamplerKind::Residual, UpsamplerKind::StyleGan2] {
        let name = |what: &str| format!("upsampler: {kind:?}, {what}");
        cases.push(Lift { kind, size: 4, masks: 1.0, rest: 1.0 }.case(name("4 pixels wide")));
        cases.push(Lift { kind, size: 4, masks: 0.0, rest: 0.0 }.case(name("nothing rendered, zero style")));
        cases.push(Lift { kind, size: 4, masks: 1e6, rest: 1.0 }.case(name("masks of ±1e6")));
    }
    cases
}

fn tensor(values: &[f32], shape: &[usize]) -> Result<Tensor> {
    Ok(Tensor::from_slice(values, shape, &Device::Cpu)?)
}

/// Transmittance where densities and intervals are nothing, or endless.
fn rays() -> Vec<Case> {
    let weights = |inputs: &mut Inputs, density: &[f32], length: f32, closed: bool| -> Result<Outputs> {
        let shape = [1, density.len() / 4, 4];
        let density = inputs.variable("density", &tensor(density, &shape)?)?;
        let lengths = inputs.variable("lengths", &Tensor::full(length, &shape, &Device::Cpu)?)?;
        let light = RayWeights::new(&density, &lengths, closed)?;
        Ok(vec![("weights", light.weights), ("remaining", light.remaining)])
    };
    vec![
        Case::new("aggregation: empty space", move |inputs| weights(inputs, &[0.0; 8], 0.01, false)),
        Case::new("aggregation: empty space, closed", move |inputs| weights(inputs, &[0.0; 8], 0.01, true)),
        Case::new("aggregation: densities from 1e-9 to 1e12", move |inputs| {
            weights(inputs, &[1e-9, 1e-3, 1.0, 1e12, 1e12, 1.0, 1e-3, 1e-9], 0.01, false)
        }),
        Case::new("aggregation: an interval of 1e10", move |inputs| {
            weights(inputs, &[1e-12, 1e-11, 0.0, 1.0], 1e10, false)
        }),
        Case::new("aggregation: denormal densities", move |inputs| weights(inputs, &[1e-40; 4], 0.01, false)),
    ]
}

const EDGES: &[f32] = &[0.0, 1e-30, -1e-30, 1.0, -1.0, 50.0, -50.0, 1e4, -1e4];

fn loss_terms() -> Vec<Case> {
    let edges = |inputs: &mut Inputs, name: &str| inputs.variable(name, &tensor(EDGES, &[EDGES.len(), 1])?);
    vec![
        Case::new("loss: logistic at 0, ±1e-30, ±50 and ±1e4", move |inputs| {
            let (real, fake) = (edges(inputs, "real")?, edges(inputs, "fake")?);
            Ok(vec![
                ("discriminator", adversarial::logistic_loss(&real, &fake)?),
                ("generator", adversarial::generator_loss(&fake)?),
            ])
        }),
        Case::new("loss: opacity of 0 and 1 against 0 and 1", |inputs| {
            let predicted = inputs.variable("predicted", &tensor(&[0.0, 0.0, 1.0, 1.0, 0.5], &[1, 5])?)?;
            let target = inputs.constant(&tensor(&[0.0, 1.0, 0.0, 1.0, 0.5], &[1, 5])?)?;
            Ok(vec![("loss", losses::opacity(&predicted, &target)?)])
        }),
        Case::new("loss: classification of scores ±1e4", |inputs| {
            let scores = inputs.variable("scores", &tensor(&[1e4, 0.0, -1e4, 0.0, 0.0, 0.0], &[2, 3])?)?;
            let labels = Tensor::new(&[2u32, 0], &Device::Cpu)?;
            Ok(vec![("loss", losses::classification(&scores, &labels)?)])
        }),
        Case::new("loss: minimal surface at distances of 0 and ±1e3", |inputs| {
            let distance = inputs.variable("distance", &tensor(&[0.0, 1e-6, -1e-6, 1e3, -1e3], &[1, 5])?)?;
            Ok(vec![("loss", losses::minimal_surface(&distance, losses::MINIMAL_SURFACE_SHARPNESS)?)])
        }),
        Case::new("loss: eikonal where ∇d is zero, 1e-20 and 1e3", |inputs| {
            let gradient = tensor(&[0.0, 1e-20, 1e3, 0.0, 0.0, -1e3, 0.0, 0.0, 1e3], &[1, 3, 3])?;
            Ok(vec![("loss", losses::eikonal(&inputs.variable("gradient", &gradient)?)?)])
        }),
        Case::new("norm: at zero, 1e-30 and 1e15", |inputs| {
            let vectors = tensor(&[0.0, 0.0, 0.0, 1e-30, 0.0, 0.0, 1e15, -1e15, 1e15], &[3, 3])?;
            Ok(vec![("norm", norm(&inputs.variable("vectors", &vectors)?)?)])
        }),
        Case::new("norm: path lengths of zero", |inputs| {
            let gradient = inputs.variable("gradient", &Tensor::zeros((2, 3, 4), DType::F32, &Device::Cpu)?)?;
            let mean = inputs.constant(&Tensor::new(0.5f32, &Device::Cpu)?)?;
            let path = PathLength::new(&[gradient], &mean, 0.01)?;
            Ok(vec![("penalty", path.penalty), ("lengths", path.lengths)])
        }),
        Case::new("norm: pixel norm of zero, 1e-20 and 1e15", |inputs| {
            let rows = tensor(&[0.0, 0.0, 0.0, 1e-20, -1e-20, 0.0, 1e15, -1e15, 3e14], &[3, 3])?;
            Ok(vec![("rows", pixel_norm(&inputs.variable("rows", &rows)?)?)])
        }),
    ]
}

/// A discriminator and its R1 penalty.
#[derive(Clone, Copy)]
struct Judge {
    kind: DiscriminatorKind,
    batch: usize,
    /// Factor on all weights.
    weights: f64,
    /// Deviation of the pictures' values.
    pictures: f64,
}

const JUDGED_RESOLUTION: usize = 16;

impl Judge {
    fn case(self, name: impl Into<String>) -> Case {
        Case::new(name, move |inputs| {
            let resolution = JUDGED_RESOLUTION;
            let config = DiscriminatorConfig { kind: self.kind, resolution, channel_multiplier: 0.02 };
            let mut weights = fresh(|parameters| Discriminator::new(&config, parameters))?;
            scale(&mut weights, self.weights)?;
            let parameters = inputs.parameters(&weights)?;
            let discriminator = Discriminator::new(&config, &parameters)?;
            inputs.differentiate(&parameters);
            let channels = if self.kind == DiscriminatorKind::Semantic { 1 } else { REGION_COUNT };
            let image = inputs.normal("image", &[self.batch, 3, resolution, resolution], self.pictures)?;
            let masks = inputs.normal("masks", &[self.batch, channels, resolution, resolution], self.pictures)?;
            let (judgement, gradients) = discriminator.forward_with_input_gradients(&image, &masks)?;
            let mut outputs = vec![
                ("realness", judgement.realness),
                ("R1 of the image", adversarial::r1(&gradients.image)?),
                ("R1 of the masks", adversarial::r1(&gradients.masks)?),
            ];
            outputs.extend(judgement.view.map(|view| ("view", view)));
            outputs.extend(judgement.class.map(|class| ("class", class)));
            Ok(outputs)
        })
    }
}

fn scale(weights: &mut Tensors, factor: f64) -> Result<()> {
    for weight in weights.values_mut() {
        *weight = (&*weight * factor)?;
    }
    Ok(())
}

/// An upsampler on a small render.
#[derive(Clone, Copy)]
struct Lift {
    kind: UpsamplerKind,
    size: usize,
    /// Deviation of the masks.
    masks: f64,
    /// Deviation of colours, features, normals and style.
    rest: f64,
}

impl Lift {
    fn case(self, name: impl Into<String>) -> Case {
        Case::new(name, move |inputs| {
            let (size, style_dim, width) = (self.size, 8, 6);
            let config = match self.kind {
                UpsamplerKind::Residual => UpsamplerConfig::ours(style_dim),
                UpsamplerKind::StyleGan2 => UpsamplerConfig::paper(style_dim),
            };
            let resolutions = 2;
            let config = UpsamplerConfig {
                input_resolution: size,
                output_resolution: 2 * size,
                channels: vec![5; resolutions],
                blocks: if config.blocks.is_empty() { Vec::new() } else { vec![1; resolutions] },
                ..config
            };
            let weights = fresh(|parameters| Upsampler::new(&config, width, style_dim, parameters))?;
            let parameters = inputs.parameters(&weights)?;
            let upsampler = Upsampler::new(&config, width, style_dim, &parameters)?;
            inputs.differentiate(&parameters);
            let mut picture = |name: &'static str, channels: usize, deviation: f64| {
                inputs.normal(name, &[1, channels, size, size], deviation)
            };
            let input = UpsamplerInput {
                colour: picture("colour", 3, self.rest)?.tanh()?,
                masks: picture("masks", REGION_COUNT, self.masks)?,
                features: picture("features", width, self.rest)?,
                normal: Some(picture("normal", 3, self.rest)?),
            };
            let style = inputs.normal("style", &[1, style_dim], self.rest)?;
            let output = upsampler.forward(&input, &style, Noise::Stored)?;
            Ok(vec![("rgb", output.rgb), ("masks", output.masks)])
        })
    }
}
