//! The upsampler's opponent: a high-resolution discriminator on whole pictures, or on squares of them.

use std::sync::Arc;

use candle_core::{DType, Tensor};

use super::pairs::Square;
use crate::{
    data::{
        dataset::Dataset,
        loader::{Loader, LoaderConfig},
    },
    error::{Error, Result},
    model::{
        discriminator::{Discriminator, DiscriminatorConfig, DiscriminatorKind},
        file::Tensors,
    },
    parameters::Parameters,
    rng::Stream,
    train::{
        adversarial::{Auxiliary, Pictures, R1Weights, discriminator_loss, generator_terms},
        augment::{Augmenter, Purpose},
        config::{TrainConfig, UpsamplerStageConfig},
        events::Metrics,
        optimiser::{Adam, Betas, Group},
        trainer::Inputs,
    },
};

/// The discriminator, and what trains it.
pub(super) struct Adversary {
    discriminator: Discriminator,
    parameters: Parameters,
    optimiser: Adam,
    augmenter: Augmenter,
    photos: Option<Photos>,
}

/// Real pictures where there are no pairs.
struct Photos {
    loader: Loader,
    next: usize,
    source: (Arc<Dataset>, LoaderConfig),
}

/// Pictures with their regions, real or not.
pub(super) struct Judged {
    /// `[B, 3, side, side]` in [-1, 1].
    pub image: Tensor,
    /// `[B, 9, side, side]`.
    pub masks: Tensor,
}

impl Judged {
    /// Both, one after the other.
    pub fn and(self, other: &Self) -> Result<Self> {
        Ok(Self {
            image: Tensor::cat(&[&self.image, &other.image], 0)?,
            masks: Tensor::cat(&[&self.masks, &other.masks], 0)?,
        })
    }

    /// What the discriminator sees of them.
    fn seen(&self, square: Square, hard_masks: bool) -> Result<Self> {
        let masks = square.of(&self.masks, 1)?;
        let masks = if hard_masks { hard(&masks)? } else { masks };
        Ok(Self { image: square.of(&self.image, 1)?, masks })
    }

    /// The same as the discriminator is shown them.
    fn augmented(&self, augmenter: &Augmenter, step: usize, purpose: Purpose) -> Result<Self> {
        let (image, masks) = augmenter.apply(step, purpose, Pictures { image: &self.image, masks: &self.masks })?;
        Ok(Self { image, masks })
    }
}

impl Adversary {
    /// A fresh discriminator; it reads its own real pictures if `photos`, else they come with each step.
    pub fn new(config: &TrainConfig, inputs: &Inputs, resolution: usize, photos: bool) -> Result<Self> {
        let stage = &config.upsampler;
        let parameters = Parameters::fresh(config.seed, DType::F32, &inputs.device);
        let discriminator = DiscriminatorConfig {
            kind: DiscriminatorKind::HighResolution,
            resolution: stage.adversarial_crop.min(resolution),
            channel_multiplier: stage.channel_multiplier,
        };
        let discriminator = Discriminator::new(&discriminator, &parameters.within("discriminator"))?;
        let photos = photos
            .then(|| {
                let loader = LoaderConfig {
                    resolutions: vec![resolution],
                    batch: stage.batch,
                    mirror: config.mirror,
                    seed: config.seed,
                    share: inputs.team.share(),
                    ..LoaderConfig::default()
                };
                let source = (Arc::clone(&inputs.dataset), loader);
                Ok::<_, Error>(Photos { loader: Loader::new(Arc::clone(&source.0), &source.1)?, next: 0, source })
            })
            .transpose()?;
        let betas = Betas { first: stage.discriminator_betas[0], second: stage.discriminator_betas[1] };
        let group = Group {
            variables: parameters.variables(),
            learning_rate: stage.discriminator_learning_rate,
            largest_gradient_norm: None,
        };
        let optimiser = Adam::new(vec![group], betas).in_team(&inputs.team);
        let augmenter = Augmenter::new(stage.augment_target, stage.augment_ramp_images, config.seed, &inputs.team);
        Ok(Self { discriminator, parameters, optimiser, augmenter, photos })
    }

    /// The photos of a step, for a run without pairs.
    pub fn photos(&mut self, step: usize) -> Result<Option<Judged>> {
        let Some(photos) = &mut self.photos else { return Ok(None) };
        if step != photos.next {
            photos.loader = Loader::resume(Arc::clone(&photos.source.0), &photos.source.1, step as u64)?;
        }
        photos.next = step + 1;
        let batch = photos.loader.next_batch()?;
        let level = batch.levels.first().ok_or_else(|| Error::config("loader.resolutions", "give at least one"))?;
        let device = self.parameters.device();
        Ok(Some(Judged { image: level.images.to_device(&device)?, masks: level.masks.to_device(&device)? }))
    }

    /// Trains the discriminator on a step's pictures, and returns what it asks of the generator; nothing while the
    /// discriminator still runs ahead alone.
    ///
    /// The same generated pictures teach both: their gradient is the generator's alone, and the discriminator takes
    /// them as they are, so nothing is biased by making them once.
    pub fn judge(
        &mut self,
        config: &UpsamplerStageConfig,
        step: usize,
        [real, fake]: [&Judged; 2],
        random: &mut Stream,
        metrics: &mut Metrics,
    ) -> Result<Option<Tensor>> {
        let side = self.discriminator.config().resolution;
        let [real, fake] = [real, fake].map(|pictures| {
            let square = Square::random(side, pictures.image.dim(2)?, random);
            pictures.seen(square, config.hard_masks)
        });
        let real = real?.augmented(&self.augmenter, step, Purpose::Real)?;
        let fake = fake?.augmented(&self.augmenter, step, Purpose::Fake)?;
        let (image, masks) = (fake.image.detach(), fake.masks.detach());
        let weights = R1Weights { image: config.r1_image, masks: config.r1_mask };
        let penalty = step.is_multiple_of(config.r1_steps.max(1)).then(|| weights.every(config.r1_steps.max(1)));
        let loss = discriminator_loss(
            &self.discriminator,
            Pictures { image: &real.image, masks: &real.masks },
            Pictures { image: &image, masks: &masks },
            Auxiliary::None,
            penalty,
        )?;
        metrics.push_loss("discriminator", &loss.logistic)?;
        metrics.check_finite()?;
        self.optimiser.step(&loss.total.backward()?, 1.0)?;
        self.augmenter.adapt(&loss.real, metrics)?;
        if step < config.discriminator_ahead_steps {
            return Ok(None);
        }
        let pictures = Pictures { image: &fake.image, masks: &fake.masks };
        let terms = generator_terms(&self.discriminator, pictures, Auxiliary::None)?;
        metrics.push_loss("adversarial", &terms.adversarial)?;
        Ok(Some((terms.total * config.adversarial)?))
    }

    /// Adds weights, optimiser and augmentation to a checkpoint.
    pub fn save(&self, tensors: &mut Tensors) -> Result<()> {
        tensors.extend(self.parameters.snapshot()?);
        self.augmenter.save(tensors)?;
        self.optimiser.save("adam_discriminator", tensors)
    }

    /// Reads what [`Self::save`] added.
    pub fn load(&mut self, tensors: &Tensors) -> Result<()> {
        self.parameters.restore(tensors)?;
        self.augmenter.load(tensors)?;
        self.optimiser.load("adam_discriminator", tensors)
    }
}

/// 1 where a region's share is the largest of its pixel, else 0; where several are, the first's.
fn hard(masks: &Tensor) -> Result<Tensor> {
    let winners = masks.detach().argmax_keepdim(1)?;
    let regions = Tensor::arange(0u32, masks.dim(1)? as u32, masks.device())?.reshape((1, (), 1, 1))?;
    Ok(regions.broadcast_eq(&winners)?.to_dtype(masks.dtype())?)
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;

    #[test]
    fn hard_masks_are_a_partition_by_the_largest_share() {
        let shares = [[0.2f32, 0.5], [0.7, 0.5], [0.1, 0.0]];
        let masks = Tensor::new(&shares, &Device::Cpu).unwrap().reshape((1, 3, 1, 2)).unwrap();
        let hard = hard(&masks).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(hard, [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    }
}
