//! A discriminator that sees what a trained classifier sees: small heads on the frozen feature maps of the LPIPS network,
//! and one on the pixels (after Sauer et al., Projected GANs Converge Faster, 2021).
//!
//! A discriminator of pixels was still at chance after hundreds of steps on nine hundred photos; the classifier's features
//! tell hair from felt from the first step on, and the perceptual loss has computed them already. What the classifier is
//! blind to, patterns of the period of its first stride, the head on the pixels sees.

use candle_core::{DType, Tensor};

use crate::{
    error::Result,
    eval::perceptual::Backbone,
    model::{
        file::Tensors,
        layers::{Convolution, leaky_relu},
    },
    parameters::Parameters,
    train::{
        config::UpsamplerStageConfig,
        events::Metrics,
        optimiser::{Adam, Betas, Group},
        trainer::Inputs,
    },
};

/// Feature maps judged, from the finest: later ones see parts of faces, which the pairs teach better.
const JUDGED_MAPS: usize = 3;
/// Channels within a head.
const WIDTH: usize = 32;

/// Pictures as the critic sees them.
pub(super) struct Seen {
    /// `[B, 3, H, W]` in [-1, 1].
    pub pixels: Tensor,
    /// Maps of the classifier, `[B, C, h, w]` each.
    pub features: Vec<Tensor>,
}

/// The heads, and what trains them.
pub(super) struct Critic {
    heads: Vec<Head>,
    /// The same heads, for gradients that pass through without reaching them.
    judges: Vec<Head>,
    parameters: Parameters,
    optimiser: Adam,
}

/// Three convolutions: a verdict at every place of a map.
struct Head {
    first: Convolution,
    second: Convolution,
    verdict: Convolution,
}

impl Critic {
    /// Fresh heads for the features of `backbone`.
    pub fn new(config: &UpsamplerStageConfig, seed: u64, backbone: Backbone, inputs: &Inputs) -> Result<Self> {
        let parameters = Parameters::fresh(seed, DType::F32, &inputs.device);
        let heads = |parameters: &Parameters| -> Result<Vec<Head>> {
            let pixels = Head::new(3, 3, &parameters.within("critic.pixels"));
            let maps = backbone.channels().into_iter().take(JUDGED_MAPS).enumerate();
            let maps = maps
                .map(|(map, channels)| Head::new(channels, 1, &parameters.within(format_args!("critic.map.{map}"))));
            std::iter::once(pixels).chain(maps).collect()
        };
        let betas = Betas { first: config.discriminator_betas[0], second: config.discriminator_betas[1] };
        let (heads, judges) = (heads(&parameters)?, heads(&parameters.frozen())?);
        let group = Group {
            variables: parameters.variables(),
            learning_rate: config.critic_learning_rate,
            largest_gradient_norm: None,
        };
        Ok(Self { heads, judges, optimiser: Adam::new(vec![group], betas).in_team(&inputs.team), parameters })
    }

    /// Trains the heads to tell `real` from `fakes` (hinge loss), and returns what they ask of the generator, which is
    /// that they take its pictures for real.
    pub fn judge(&mut self, real: &Seen, fakes: &[Seen], metrics: &mut Metrics) -> Result<Tensor> {
        let share = 1.0 / fakes.len().max(1) as f64;
        let scales = real.scales()?;
        let margin =
            |heads: &[Head], seen: &Seen, sign: f64| mean(heads, seen, &scales, |v| Ok(v.affine(sign, 1.0)?.relu()?));
        let mut loss = margin(&self.heads, &real.detached(), -1.0)?;
        for fake in fakes {
            loss = (loss + (margin(&self.heads, &fake.detached(), 1.0)? * share)?)?;
        }
        metrics.push_loss("critic", &loss)?;
        metrics.check_finite()?;
        self.optimiser.step(&loss.backward()?, 1.0)?;
        let asked = fakes.iter().map(|fake| mean(&self.judges, fake, &scales, |verdict| Ok(verdict.neg()?)));
        let asked = Tensor::stack(&asked.collect::<Result<Vec<_>>>()?, 0)?.mean_all()?;
        metrics.push_loss("criticised", &asked)?;
        Ok(asked)
    }

    /// Adds weights and optimiser to a checkpoint.
    pub fn save(&self, tensors: &mut Tensors) -> Result<()> {
        tensors.extend(self.parameters.snapshot()?);
        self.optimiser.save("adam_critic", tensors)
    }

    /// Reads what [`Self::save`] added.
    pub fn load(&mut self, tensors: &Tensors) -> Result<()> {
        self.parameters.restore(tensors)?;
        self.optimiser.load("adam_critic", tensors)
    }
}

/// Mean over heads and places of a function of the verdicts.
fn mean(heads: &[Head], seen: &Seen, scales: &[Tensor], of: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Tensor> {
    let judged = heads.iter().zip(seen.maps()).zip(scales);
    let means = judged.map(|((head, map), scale)| Ok(of(&head.forward(&map.broadcast_mul(scale)?)?)?.mean_all()?));
    Ok(Tensor::stack(&means.collect::<Result<Vec<_>>>()?, 0)?.mean_all()?)
}

impl Seen {
    /// What each head sees.
    fn maps(&self) -> impl Iterator<Item = &Tensor> {
        std::iter::once(&self.pixels).chain(self.features.iter().take(JUDGED_MAPS))
    }

    /// The same without the way back to the generator.
    fn detached(&self) -> Self {
        Self { pixels: self.pixels.detach(), features: self.features.iter().map(Tensor::detach).collect() }
    }

    /// Factors that bring each map of these pictures to a mean square of 1: maps differ by orders of magnitude.
    fn scales(&self) -> Result<Vec<Tensor>> {
        self.maps().map(|map| Ok((map.detach().sqr()?.mean_all()? + 1e-8)?.sqrt()?.recip()?)).collect()
    }
}

impl Head {
    fn new(inputs: usize, kernel: usize, parameters: &Parameters) -> Result<Self> {
        let layer = |inputs, outputs, kernel, name: &str| {
            // √3 turns PyTorch's uniform start into one that keeps the variance.
            Convolution::new(inputs, outputs, kernel, 3f64.sqrt(), &parameters.within(name))
        };
        Ok(Self {
            first: layer(inputs, WIDTH, kernel, "first")?,
            second: layer(WIDTH, WIDTH, 3, "second")?,
            verdict: layer(WIDTH, 1, 1, "verdict")?,
        })
    }

    /// `[B, C, h, w]` → `[B, 1, h, w]`.
    fn forward(&self, map: &Tensor) -> Result<Tensor> {
        let hidden = leaky_relu(&self.first.forward(map)?)?;
        self.verdict.forward(&leaky_relu(&self.second.forward(&hidden)?)?)
    }
}
