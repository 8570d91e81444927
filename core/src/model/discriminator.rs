//! The three discriminators of the paper, with the explicit graph of their input gradients for R1.
//!
//! - global: image and mask branches added, residual CNN on coordinates (CoordConv), minibatch deviation; real or fake,
//!   and the azimuth and elevation it sees;
//! - semantic: one region's image × mask, and the mask; real or fake, and which region it is;
//! - high resolution: StyleGAN2's residual discriminator with an image and a mask branch.
//!
//! Structure, channel tables and scales follow the authors' code. Channels are those tables times a multiplier.

mod blocks;

use candle_core::{DType, Tensor};
use serde::{Deserialize, Serialize};

use self::blocks::{Family, Layer, LayerShape, ResidualBlock, Tape, minibatch_deviation};
use crate::{
    error::{Error, Result},
    model::layers::EqualLinear,
    parameters::Parameters,
    region::{REGION_COUNT, Region},
};

/// Which of the discriminators.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DiscriminatorKind {
    /// Renders with all their masks; also predicts the viewing angles.
    Global,
    /// One region of a render; also predicts which region.
    Semantic,
    /// Upsampled pictures with all their masks.
    HighResolution,
}

/// What a discriminator is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiscriminatorConfig {
    /// Which one.
    pub kind: DiscriminatorKind,
    /// Width and height of its pictures, pixels; a power of two.
    pub resolution: usize,
    /// Factor on the authors' channel tables: 1 for the paper, less for a CPU.
    pub channel_multiplier: f64,
}

impl DiscriminatorConfig {
    /// Channels at `resolution` in the authors' tables, times the multiplier.
    fn channels(&self, resolution: usize) -> usize {
        let authors = match (self.kind, resolution) {
            (DiscriminatorKind::Global, ..=16) => 400,
            (DiscriminatorKind::Global, ..=32) => 256,
            (DiscriminatorKind::Global, ..=64) => 128,
            (DiscriminatorKind::Global, _) => 64,
            (DiscriminatorKind::Semantic, ..=32) => 512,
            (DiscriminatorKind::Semantic, ..=64) => 256,
            (DiscriminatorKind::Semantic, _) => 128,
            (DiscriminatorKind::HighResolution, ..=64) => 512,
            (DiscriminatorKind::HighResolution, ..=128) => 256,
            (DiscriminatorKind::HighResolution, ..=256) => 128,
            (DiscriminatorKind::HighResolution, ..=512) => 64,
            (DiscriminatorKind::HighResolution, _) => 32,
        };
        ((f64::from(authors) * self.channel_multiplier).round() as usize).max(1)
    }

    fn validate(&self) -> Result<()> {
        if !self.resolution.is_power_of_two() || self.resolution < 8 {
            let reason = format!("{} is not a power of two of at least 8", self.resolution);
            return Err(Error::config("discriminator.resolution", reason));
        }
        if !(self.channel_multiplier > 0.0 && self.channel_multiplier.is_finite()) {
            return Err(Error::config("discriminator.channel_multiplier", "must be a positive number"));
        }
        Ok(())
    }
}

/// What a discriminator says about a batch.
#[derive(Clone, Debug)]
pub struct Judgement {
    /// Logit of being real, `[B, 1]`.
    pub realness: Tensor,
    /// Azimuth and elevation, radians, `[B, 2]` (global only).
    pub view: Option<Tensor>,
    /// Logits of the regions, `[B, 9]` (semantic only).
    pub class: Option<Tensor>,
}

/// Gradients of the summed realness with respect to the inputs, differentiable in the discriminator's weights.
#[derive(Clone, Debug)]
pub struct InputGradients {
    /// `[B, 3, r, r]`.
    pub image: Tensor,
    /// `[B, 9, r, r]`; `[B, 1, r, r]` for the semantic discriminator.
    pub masks: Tensor,
}

/// A discriminator.
#[derive(Clone, Debug)]
pub struct Discriminator {
    config: DiscriminatorConfig,
    image: Branch,
    masks: Branch,
    last: Layer,
    heads: Heads,
}

/// 1×1 convolution and residual blocks, each halving the picture.
#[derive(Clone, Debug)]
struct Branch {
    first: Layer,
    blocks: Vec<ResidualBlock>,
}

#[derive(Clone, Debug)]
enum Heads {
    /// The last convolution's channels are realness, azimuth and elevation.
    View,
    /// Two linear layers from the flattened picture.
    Realness([EqualLinear; 2]),
    /// The same, and as many for the class.
    RealnessAndClass([EqualLinear; 2], [EqualLinear; 2]),
}

impl Discriminator {
    /// Builds the network of `config`.
    ///
    /// # Errors
    /// [`Error::Config`] when the resolution or the multiplier cannot be used.
    pub fn new(config: &DiscriminatorConfig, parameters: &Parameters) -> Result<Self> {
        config.validate()?;
        let kind = config.kind;
        let masks = if kind == DiscriminatorKind::Semantic { 1 } else { REGION_COUNT };
        let smallest = if kind == DiscriminatorKind::Global { 2 } else { 4 };
        let features = config.channels(smallest);
        let (last, heads) = {
            let parameters_last = parameters.within("last");
            let linears = |name, flat, outputs| -> Result<[EqualLinear; 2]> {
                let parameters = parameters.within(name);
                Ok([
                    EqualLinear::new(flat, features, 0.0, 1.0, true, &parameters.within(0))?,
                    EqualLinear::new(features, outputs, 0.0, 1.0, false, &parameters.within(1))?,
                ])
            };
            // One channel more than the branches give: the minibatch deviation.
            match kind {
                DiscriminatorKind::Global => {
                    let shape = LayerShape { padding: 0, ..LayerShape::linear(features + 1, 3, 2) };
                    (Layer::new(Family::Coordinates, shape, &parameters_last)?, Heads::View)
                }
                DiscriminatorKind::Semantic => {
                    let shape = LayerShape { padding: 0, ..LayerShape::linear(features + 1, features, 3) };
                    let realness = linears("realness", features * 4, 1)?;
                    let class = linears("class", features * 4, REGION_COUNT)?;
                    (
                        Layer::new(Family::Coordinates, shape, &parameters_last)?,
                        Heads::RealnessAndClass(realness, class),
                    )
                }
                DiscriminatorKind::HighResolution => {
                    let shape = LayerShape::activated(features + 1, features, 3);
                    let realness = linears("realness", features * 16, 1)?;
                    (Layer::new(Family::StyleGan2, shape, &parameters_last)?, Heads::Realness(realness))
                }
            }
        };
        Ok(Self {
            config: config.clone(),
            image: Branch::new(config, 3, smallest, &parameters.within("image"))?,
            masks: Branch::new(config, masks, smallest, &parameters.within("masks"))?,
            last,
            heads,
        })
    }

    /// What the network is.
    pub fn config(&self) -> &DiscriminatorConfig {
        &self.config
    }

    /// Judges pictures in [−1, 1], `[B, 3, r, r]`, with their masks `[B, 9, r, r]`; the semantic discriminator takes
    /// the one mask of the region in question, `[B, 1, r, r]` ([`select_masks`]), and cuts the image by it.
    pub fn forward(&self, image: &Tensor, masks: &Tensor) -> Result<Judgement> {
        Ok(self.pass(image, masks)?.0)
    }

    /// As [`Self::forward`], with the gradients of the summed realness.
    pub fn forward_with_input_gradients(&self, image: &Tensor, masks: &Tensor) -> Result<(Judgement, InputGradients)> {
        let (judgement, tapes) = self.pass(image, masks)?;
        let summed = tapes.head.run(&judgement.realness.ones_like()?.detach())?;
        let (mut image_gradient, mut mask_gradient) = (tapes.image.run(&summed)?, tapes.masks.run(&summed)?);
        if self.config.kind == DiscriminatorKind::Semantic {
            mask_gradient = (mask_gradient + (&image_gradient * image)?.sum_keepdim(1)?)?;
            image_gradient = image_gradient.broadcast_mul(masks)?;
        }
        Ok((judgement, InputGradients { image: image_gradient, masks: mask_gradient }))
    }

    /// Features of the image branch alone after every block, from fine to coarse.
    pub fn image_features(&self, image: &Tensor) -> Result<Vec<Tensor>> {
        let mut tape = Tape::default();
        let mut hidden = self.image.first.forward(image, &mut tape)?;
        let mut features = Vec::new();
        for block in &self.image.blocks {
            hidden = block.forward(&hidden, &mut tape)?;
            features.push(hidden.clone());
        }
        Ok(features)
    }

    fn pass(&self, image: &Tensor, masks: &Tensor) -> Result<(Judgement, Tapes<'_>)> {
        let (_, _, height, width) = image.dims4()?;
        if (height, width) != (self.config.resolution, self.config.resolution) {
            let side = self.config.resolution;
            return Err(Error::shape("discriminator's image", format!("[B, 3, {side}, {side}]"), image.dims()));
        }
        let mut tapes = Tapes::default();
        let features = match self.config.kind {
            DiscriminatorKind::Semantic => self.image.forward(&image.broadcast_mul(masks)?, &mut tapes.image)?,
            _ => self.image.forward(image, &mut tapes.image)?,
        };
        let summed = (features + self.masks.forward(masks, &mut tapes.masks)?)?;
        let hidden = minibatch_deviation(&summed, &mut tapes.head)?;
        let hidden = self.last.forward(&hidden, &mut tapes.head)?;
        let shape = hidden.dims4()?;
        let flat = hidden.flatten_from(1)?;
        tapes.head.push(move |gradient| Ok(gradient.reshape(shape)?));
        let judgement = match &self.heads {
            Heads::View => {
                tapes.head.push(move |gradient| {
                    let rest = Tensor::zeros((shape.0, 2), gradient.dtype(), gradient.device())?;
                    Ok(Tensor::cat(&[gradient, &rest], 1)?)
                });
                Judgement { realness: flat.narrow(1, 0, 1)?, view: Some(flat.narrow(1, 1, 2)?), class: None }
            }
            Heads::Realness(realness) => {
                Judgement { realness: blocks::linears(realness, &flat, &mut tapes.head)?, view: None, class: None }
            }
            Heads::RealnessAndClass(realness, class) => {
                let class = class.iter().try_fold(flat.clone(), |hidden, layer| layer.forward(&hidden))?;
                let realness = blocks::linears(realness, &flat, &mut tapes.head)?;
                Judgement { realness, view: None, class: Some(class) }
            }
        };
        Ok((judgement, tapes))
    }
}

/// The adjoint steps of a pass: from the realness to the branches' sum, and from there to either input.
#[derive(Default)]
struct Tapes<'a> {
    head: Tape<'a>,
    image: Tape<'a>,
    masks: Tape<'a>,
}

impl Branch {
    fn new(config: &DiscriminatorConfig, inputs: usize, smallest: usize, parameters: &Parameters) -> Result<Self> {
        let family = match config.kind {
            DiscriminatorKind::HighResolution => Family::StyleGan2,
            DiscriminatorKind::Global | DiscriminatorKind::Semantic => Family::Coordinates,
        };
        let mut resolution = config.resolution;
        let mut channels = config.channels(resolution);
        // The authors leave the semantic mask branch's first layer linear.
        let first = if config.kind == DiscriminatorKind::Semantic && inputs == 1 {
            LayerShape::linear(inputs, channels, 1)
        } else {
            LayerShape::activated(inputs, channels, 1)
        };
        let first = Layer::new(family, first, &parameters.within("first"))?;
        let mut blocks = Vec::new();
        while resolution > smallest {
            resolution /= 2;
            let parameters = parameters.within(format_args!("block.{}", blocks.len()));
            let outputs = config.channels(resolution);
            blocks.push(ResidualBlock::new(family, channels, outputs, &parameters)?);
            channels = outputs;
        }
        Ok(Self { first, blocks })
    }

    fn forward<'a>(&'a self, input: &Tensor, tape: &mut Tape<'a>) -> Result<Tensor> {
        let first = self.first.forward(input, tape)?;
        self.blocks.iter().try_fold(first, |hidden, block| block.forward(&hidden, tape))
    }
}

/// The mask of one region for every picture: `masks` `[B, 9, h, w]`, one of `regions` for each → `[B, 1, h, w]`.
pub fn select_masks(masks: &Tensor, regions: &[Region]) -> Result<Tensor> {
    let (batch, count, _, _) = masks.dims4()?;
    if regions.len() != batch || count != REGION_COUNT {
        return Err(Error::shape("masks", format!("[{}, {REGION_COUNT}, h, w]", regions.len()), masks.dims()));
    }
    let one = |(index, region): (usize, &Region)| masks.narrow(0, index, 1)?.narrow(1, region.index(), 1);
    let selected = regions.iter().enumerate().map(one).collect::<candle_core::Result<Vec<_>>>()?;
    Ok(Tensor::cat(&selected, 0)?)
}

/// The labels of `regions` for a class loss, `[B]`, u32.
pub fn class_labels(regions: &[Region], device: &candle_core::Device) -> Result<Tensor> {
    let labels: Vec<u32> = regions.iter().map(|region| *region as u32).collect();
    Ok(Tensor::from_vec(labels, regions.len(), device)?.to_dtype(DType::U32)?)
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;
    use crate::model::upsampler::tests::{check_parameter_gradients, random, relative_error};

    const KINDS: [DiscriminatorKind; 3] =
        [DiscriminatorKind::Global, DiscriminatorKind::Semantic, DiscriminatorKind::HighResolution];

    fn build(kind: DiscriminatorKind) -> (Discriminator, Parameters, usize) {
        let parameters = Parameters::fresh(5, DType::F64, &Device::Cpu);
        // Wide enough apart that the global discriminator has blocks with and without a skip convolution.
        let resolution = if kind == DiscriminatorKind::Global { 32 } else { 16 };
        let config = DiscriminatorConfig { kind, resolution, channel_multiplier: 1.0 / 128.0 };
        let network = Discriminator::new(&config, &parameters).unwrap();
        (network, parameters, resolution)
    }

    fn inputs(kind: DiscriminatorKind, batch: usize, resolution: usize) -> (Tensor, Tensor) {
        let masks = if kind == DiscriminatorKind::Semantic { 1 } else { 9 };
        (random(1, &[batch, 3, resolution, resolution]), random(2, &[batch, masks, resolution, resolution]))
    }

    #[test]
    fn explicit_input_gradients_are_autograd_s() {
        for kind in KINDS {
            let (network, _, resolution) = build(kind);
            for batch in [1, 2, 6] {
                let (image, masks) = inputs(kind, batch, resolution);
                let (image, masks) = (Var::from_tensor(&image).unwrap(), Var::from_tensor(&masks).unwrap());
                let (judgement, gradients) = network.forward_with_input_gradients(&image, &masks).unwrap();
                assert_eq!(judgement.realness.dims(), [batch, 1]);
                let automatic = judgement.realness.sum_all().unwrap().backward().unwrap();
                for (explicit, variable) in [(gradients.image, &image), (gradients.masks, &masks)] {
                    let error = relative_error(&explicit, automatic.get(variable).unwrap());
                    assert!(error < 1e-12, "{kind:?}, batch {batch}: {error}");
                }
            }
        }
    }

    #[test]
    fn r1_parameter_gradients_match_finite_differences() {
        for kind in KINDS {
            let (network, parameters, resolution) = build(kind);
            let (image, masks) = inputs(kind, 4, resolution);
            check_parameter_gradients(&parameters, 1e-7, 1e-4, || {
                let (_, gradients) = network.forward_with_input_gradients(&image, &masks).unwrap();
                (crate::train::adversarial::r1(&gradients.image).unwrap()
                    + (crate::train::adversarial::r1(&gradients.masks).unwrap() * 100.0).unwrap())
                .unwrap()
            });
        }
    }

    #[test]
    fn r1_of_a_discriminator_that_sees_nothing_is_zero_and_finite() {
        for kind in KINDS {
            let (network, parameters, resolution) = build(kind);
            for (_, variable) in parameters.variables() {
                variable.set(&variable.zeros_like().unwrap()).unwrap();
            }
            let (image, masks) = inputs(kind, 4, resolution);
            let (_, gradients) = network.forward_with_input_gradients(&image, &masks).unwrap();
            let penalty = crate::train::adversarial::r1(&gradients.image).unwrap();
            assert_eq!(penalty.to_scalar::<f64>().unwrap(), 0.0);
            let gradients = penalty.backward().unwrap();
            for (name, variable) in parameters.variables() {
                if let Some(gradient) = gradients.get(&variable) {
                    let sum = gradient.sum_all().unwrap().to_scalar::<f64>().unwrap();
                    assert!(sum.is_finite(), "{kind:?} {name}");
                }
            }
        }
    }

    #[test]
    fn regions_are_selected_picture_by_picture() {
        let masks = random(3, &[2, 9, 4, 4]);
        let selected = select_masks(&masks, &[Region::Hair, Region::Eyes]).unwrap();
        assert_eq!(selected.dims(), [2, 1, 4, 4]);
        let hair = masks.narrow(0, 0, 1).unwrap().narrow(1, 7, 1).unwrap();
        assert_eq!(relative_error(&selected.narrow(0, 0, 1).unwrap(), &hair), 0.0);
        assert!(select_masks(&masks, &[Region::Hair]).is_err());
    }

    #[test]
    fn unusable_configurations_are_refused() {
        let parameters = Parameters::fresh(5, DType::F32, &Device::Cpu);
        for (resolution, channel_multiplier) in [(48, 1.0), (4, 1.0), (64, 0.0), (64, f64::NAN)] {
            let config = DiscriminatorConfig { kind: DiscriminatorKind::Global, resolution, channel_multiplier };
            assert!(Discriminator::new(&config, &parameters).is_err());
        }
        let (network, ..) = build(DiscriminatorKind::Global);
        let (image, masks) = inputs(DiscriminatorKind::Global, 1, 16);
        assert!(network.forward(&image, &masks).is_err());
    }
}
