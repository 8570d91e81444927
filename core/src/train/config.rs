//! What a training run does. Every number is a field with its source; presets set them together; `--set a.b=c`
//! changes one. The resolved configuration is saved beside every run and read back by `--resume`.

use serde::{Deserialize, Serialize};

use crate::{
    config::GeneratorConfig,
    error::{Error, Result},
    train::optimiser::Schedule,
};

mod presets;

/// The stages of training, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// Posed reconstruction of the training portraits, a code each (ours; a start the paper does not have).
    Warmup,
    /// The paper's first stage: the field against the global and the semantic discriminator.
    Field,
    /// The paper's second stage: the upsampler, the field frozen.
    Upsampler,
    /// All of the above that the preset asks for, one after the other.
    All,
}

/// Sets of settings that belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Procedural cartoon portraits, CPU-sized.
    Cartoon,
    /// A few hundred real portraits, CPU-sized.
    Portrait,
    /// The paper's sizes and rates.
    Ffhq,
    /// Seconds; for tests.
    Tiny,
}

/// A whole run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// The preset the values started from.
    pub preset: Preset,
    /// Seed of every draw.
    pub seed: u64,
    /// Mirrored copies of all portraits are used too.
    pub mirror: bool,
    /// Newest checkpoints kept; the best is kept beside them.
    pub keep_checkpoints: usize,
    /// Steps between checkpoints.
    pub checkpoint_steps: usize,
    /// Steps between sample grids.
    pub sample_steps: usize,
    /// Steps between lines of the log.
    pub log_steps: usize,
    /// What is trained.
    pub model: GeneratorConfig,
    /// Stage `warmup`.
    pub warmup: WarmupConfig,
    /// Stage `field`.
    pub field: FieldStageConfig,
    /// Stage `upsampler`.
    pub upsampler: UpsamplerStageConfig,
}

/// The posed reconstruction warm-up (shared/recipe: every default is the recipe's unless said otherwise).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarmupConfig {
    /// Optimiser steps; the recipe's nine minutes were 2,147, the built-in portrait model's 50 were 16,000.
    pub steps: usize,
    /// Portraits a step.
    pub batch: usize,
    /// Rays a portrait.
    pub rays: usize,
    /// Samples a ray.
    pub samples: usize,
    /// Depths between which samples are placed; the whole of every ray where the background is a region of the volume.
    pub depth_range: [f64; 2],
    /// Learning rate of field, FiLM and mapping; 0 holds them, so that codes alone are fitted to a finished field.
    pub learning_rate: f64,
    /// Learning rate of the portraits' codes.
    pub code_learning_rate: f64,
    /// Fraction of the run after which every portrait's regions get codes of their own, added to the mapped one: a z of
    /// `style_dim` numbers cannot hold a face. 1 leaves them out, as the recipe does.
    pub region_codes_from: f64,
    /// Learning rate of those.
    pub region_code_learning_rate: f64,
    /// Schedule of both.
    pub schedule: Schedule,
    /// Adam's β.
    pub betas: [f64; 2],
    /// Largest gradient norm of the field.
    pub gradient_bound: f64,
    /// α at the start and at the end, world units, moved exponentially over `alpha_hold` of the run.
    pub alpha: [f64; 2],
    /// Fraction of the run after which α stays.
    pub alpha_hold: f64,
    /// Resolution of the first and of the second part of the run, pixels.
    pub resolutions: [usize; 2],
    /// Fraction of the run at the first resolution.
    pub first_resolution_share: f64,
    /// Extra weight of eyes, eyebrows, mouth, nose and ears when pixels are drawn.
    pub detail_boost: f64,
    /// Rays start up to this far from their pixel's centre, pixels.
    pub pixel_jitter: f64,
    /// Loss weights.
    pub weights: WarmupWeights,
    /// Share of the points at which the eikonal loss is taken. They are drawn evenly, so the loss and its gradient are
    /// unbiased: in expectation the mean over all points.
    pub eikonal_share: f64,
}

/// Weights of the warm-up's losses (recipe).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarmupWeights {
    /// L1 of colours in [0, 1].
    pub colour: f64,
    /// Squared error of rendered masks.
    pub masks: f64,
    /// Cross-entropy of opacity against "not background".
    pub opacity: f64,
    /// (|∇d| - 1)².
    pub eikonal: f64,
    /// exp(-100 |d|).
    pub minimal_surface: f64,
    /// A region's colour outside its mask is pulled to its mean colour.
    pub fill: f64,
    /// Mean square of the codes.
    pub code_norm: f64,
    /// Mean square of the regions' own codes.
    pub region_code_norm: f64,
}

/// The paper's first stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldStageConfig {
    /// Optimiser steps of each player.
    pub steps: usize,
    /// Portraits a step.
    pub batch: usize,
    /// Resolution of renders and of the real pictures, pixels. Paper: 64.
    pub resolution: usize,
    /// Samples a ray. Paper: 24.
    pub samples: usize,
    /// Generator's learning rate. Paper: 2e-5.
    pub generator_learning_rate: f64,
    /// Discriminators' learning rate. Paper: 2e-4.
    pub discriminator_learning_rate: f64,
    /// Adam's β. Paper: 0, 0.9.
    pub betas: [f64; 2],
    /// Channels of the discriminators relative to the authors' tables.
    pub channel_multiplier: f64,
    /// Factor on |∇D|² of the image. Authors: 10, halved in the sum.
    pub r1_image: f64,
    /// Factor on |∇D|² of the mask. Authors: 1000, halved in the sum.
    pub r1_mask: f64,
    /// λ_view of smooth L1 between predicted and true camera angles. Paper: 15.
    pub view: f64,
    /// λ_Eik. Paper: 0.1.
    pub eikonal: f64,
    /// λ_MS. Paper: 0.001.
    pub minimal_surface: f64,
    /// Weight of the semantic discriminator's adversarial and class terms. Paper: 1; 0 trains without it.
    pub semantic: f64,
    /// Weight of L_STD. Paper: 1; 0 trains without it.
    pub decoupling: f64,
    /// Margin m of L_STD. The paper gives no number; ours 0.1, about a tenth of two portraits' feature distance.
    pub decoupling_margin: f64,
    /// Share r_t of verdicts on real pictures, E[sign(D)], that adaptive augmentation holds the global discriminator to:
    /// for sets of a few thousand pictures or fewer. ADA (Karras et al. 2020): 0.6; paper: 0, no augmentation.
    #[serde(default)]
    pub augment_target: f64,
    /// Real pictures in which the chance of augmentation could rise from 0 to 1. ADA: 500,000.
    #[serde(default)]
    pub augment_ramp_images: usize,
    /// Chance that a step mixes two codes. StyleGAN: 0.9.
    pub mixing: f64,
    /// Pictures after which an old value counts half in the averaged weights. Authors: 10,000.
    pub average_half_life_images: f64,
}

/// The upsampler's stage: paired reconstruction (recipe) and, from `adversarial` > 0, the paper's second stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpsamplerStageConfig {
    /// Optimiser steps; the recipe's 4.2 minutes were 1,347.
    pub steps: usize,
    /// Portraits a step.
    pub batch: usize,
    /// Side of the crops, pixels of the render; the whole render if it is as large. Recipe: 48 of 64.
    pub crop: usize,
    /// Learning rate. Recipe: 2e-3; paper: StyleGAN2's 2e-3.
    pub learning_rate: f64,
    /// Learning rate of the high-resolution discriminator. StyleGAN2: 2e-3.
    pub discriminator_learning_rate: f64,
    /// Schedule of the upsampler's rate.
    pub schedule: Schedule,
    /// Adam's β. Recipe: 0.9, 0.99; paper: 0, 0.99.
    pub betas: [f64; 2],
    /// Adam's β of the discriminator. Paper: 0, 0.99.
    pub discriminator_betas: [f64; 2],
    /// Weight of L1 against the portrait the code belongs to (needs a warmed-up model's codes).
    pub pixels: f64,
    /// Weight of LPIPS against it (needs `--lpips`).
    pub perceptual: f64,
    /// LPIPS sees crops enlarged by a factor drawn from 1 to this. At one fixed scale AlexNet's stride of 4 cannot tell
    /// hair from hatching of that period, and the upsampler learns to hatch.
    pub perceptual_zoom: f64,
    /// Weight of heads on the perceptual network's features that tell photos from pictures (Sauer et al., 2021). They see
    /// pairs and, with `random_portraits`, those. Paper: 0.
    pub critic: f64,
    /// Learning rate of those heads.
    pub critic_learning_rate: f64,
    /// Weight of the non-saturating adversarial loss of the high-resolution discriminator.
    pub adversarial: f64,
    /// Side of the square the discriminator sees, pixels of the picture, a power of two. Paper: the whole picture. On
    /// squares, a few hundred photos give it many times as much to learn from.
    pub adversarial_crop: usize,
    /// The discriminator sees regions by their outlines, without shares: where masks are rendered and not learnt, their
    /// softness alone would tell it real from generated. Paper: off.
    pub hard_masks: bool,
    /// Random portraits from random cameras a step, for the discriminator and for `agreement`. Paper: its whole batch;
    /// with pairs, beside them.
    pub random_portraits: usize,
    /// Weight of L1 between two views of each random portrait where both see the head, one carried to the other by the
    /// rendered depth: what is drawn stays on the surface in an orbit. Paper: 0.
    pub agreement: f64,
    /// Weight of L1 between the backgrounds of random portraits and those of their enlarged renders: no photo tells what is
    /// behind a portrait that nobody took, and a critic alone fills it with patterns. Paper: 0.
    pub calm_background: f64,
    /// Weight of the mean squared Laplacian of what is added to the enlarged renders of random portraits, outside eyes,
    /// eyebrows, nose and mouth: photos teach the detail of portraits that were taken, and nothing else keeps the others
    /// free of specks. Paper: 0.
    #[serde(default)]
    pub calm_detail: f64,
    /// Weight of the same around outlines, where regions meet: a critic sharpens faces before it sees the rows of dashes
    /// that stand there. Paper: 0.
    #[serde(default)]
    pub calm_outline: f64,
    /// Share of a random portrait's region codes that come from another one, as an edit does it. Above 0, and where there
    /// are pairs, half of the random portraits are training portraits seen from elsewhere. Paper: 0.
    #[serde(default)]
    pub exchanged_codes: f64,
    /// The second view is turned by up to this, radians; more often by less.
    pub agreement_turn_rad: f64,
    /// Steps a discriminator or critic learns alone before its verdict counts. Paper: 0.
    pub discriminator_ahead_steps: usize,
    /// Channels of the discriminator relative to the authors' tables.
    pub channel_multiplier: f64,
    /// As in the field's stage.
    pub r1_image: f64,
    /// As in the field's stage.
    pub r1_mask: f64,
    /// Steps between R1 penalties. Authors: 16.
    pub r1_steps: usize,
    /// As in the field's stage.
    #[serde(default)]
    pub augment_target: f64,
    /// As in the field's stage.
    #[serde(default)]
    pub augment_ramp_images: usize,
    /// Weight of path-length regularisation (`StyleGan2` upsamplers only). Authors: 2; 0 trains without it.
    pub path_length: f64,
    /// Steps between path-length penalties. Authors: 4.
    pub path_length_steps: usize,
    /// As in the field's stage.
    pub average_half_life_images: f64,
}

impl UpsamplerStageConfig {
    /// Whether random portraits teach the generator by themselves, without anybody who judges them.
    pub fn teaches_random_portraits(&self) -> bool {
        let calm = [self.calm_background, self.calm_detail, self.calm_outline];
        self.agreement > 0.0 || calm.iter().any(|weight| *weight > 0.0)
    }
}

impl TrainConfig {
    /// Refuses what cannot be trained.
    pub fn validate(&self) -> Result<()> {
        self.model.field.validate()?;
        let positive = |option: &str, value: usize| {
            if value == 0 { Err(Error::config(option, "must be at least 1")) } else { Ok(()) }
        };
        positive("warmup.batch", self.warmup.batch)?;
        positive("warmup.rays", self.warmup.rays)?;
        positive("warmup.samples", self.warmup.samples)?;
        positive("field.batch", self.field.batch)?;
        positive("field.samples", self.field.samples)?;
        positive("upsampler.batch", self.upsampler.batch)?;
        positive("upsampler.crop", self.upsampler.crop)?;
        if !(1.0..=4.0).contains(&self.upsampler.perceptual_zoom) {
            return Err(Error::config("upsampler.perceptual_zoom", "must be between 1 and 4"));
        }
        if !(0.0..=1.0).contains(&self.upsampler.exchanged_codes) {
            return Err(Error::config("upsampler.exchanged_codes", "must be between 0 and 1"));
        }
        for (stage, target, images) in [
            ("field", self.field.augment_target, self.field.augment_ramp_images),
            ("upsampler", self.upsampler.augment_target, self.upsampler.augment_ramp_images),
        ] {
            if !(0.0..1.0).contains(&target) {
                return Err(Error::config(format!("{stage}.augment_target"), "must be at least 0 and below 1"));
            }
            if target > 0.0 {
                positive(&format!("{stage}.augment_ramp_images"), images)?;
            }
        }
        positive("keep_checkpoints", self.keep_checkpoints)?;
        positive("checkpoint_steps", self.checkpoint_steps)?;
        positive("sample_steps", self.sample_steps)?;
        positive("log_steps", self.log_steps)?;
        if self.warmup.rays > self.warmup.resolutions[0] * self.warmup.resolutions[0] {
            return Err(Error::config("warmup.rays", "more rays than the first resolution has pixels"));
        }
        Ok(())
    }

    /// The configuration with `assignments` such as `warmup.steps=100` applied. A name that does not exist, or a value
    /// of another type, is an error that names it.
    pub fn with(&self, assignments: &[String]) -> Result<Self> {
        let mut tree = toml::Value::try_from(self).map_err(|error| Error::config("--set", error))?;
        for assignment in assignments {
            let (path, value) = assignment
                .split_once('=')
                .ok_or_else(|| Error::config("--set", format!("`{assignment}` is not of the form key=value")))?;
            let mut place = &mut tree;
            for key in path.trim().split('.') {
                let table = place.as_table_mut();
                let known = table.as_ref().map(|table| table.keys().cloned().collect::<Vec<_>>()).unwrap_or_default();
                place = table.and_then(|table| table.get_mut(key)).ok_or_else(|| {
                    Error::config(
                        format!("--set {path}"),
                        format!("there is no `{key}` here; known: {}", known.join(", ")),
                    )
                })?;
            }
            let parsed: toml::Table = toml::from_str(&format!("value = {value}"))
                .or_else(|_| toml::from_str(&format!("value = {value:?}")))
                .map_err(|error| Error::config(format!("--set {path}"), error.message()))?;
            let parsed = parsed.get("value").cloned().unwrap_or(toml::Value::Boolean(false));
            *place = match (&*place, parsed) {
                // Whole numbers may be written where a real one is meant.
                (toml::Value::Float(_), toml::Value::Integer(whole)) => toml::Value::Float(whole as f64),
                (known, parsed) if known.same_type(&parsed) => parsed,
                (known, _) => {
                    let reason = format!("`{value}` is not of the type {}", known.type_str());
                    return Err(Error::config(format!("--set {path}"), reason));
                }
            };
        }
        let config: Self = tree.try_into().map_err(|error: toml::de::Error| Error::config("--set", error.message()))?;
        config.validate()?;
        Ok(config)
    }

    /// TOML text; [`Self::from_toml`] reads it back.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|error| Error::config("config.toml", error))
    }

    /// Reads TOML text; unknown keys are errors.
    pub fn from_toml(text: &str) -> Result<Self> {
        let config: Self = toml::from_str(text).map_err(|error| Error::config("config.toml", error.message()))?;
        config.validate()?;
        Ok(config)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_valid_and_round_trips() {
        for preset in [Preset::Cartoon, Preset::Portrait, Preset::Ffhq, Preset::Tiny] {
            let config = TrainConfig::preset(preset);
            config.validate().unwrap();
            assert_eq!(TrainConfig::from_toml(&config.to_toml().unwrap()).unwrap(), config);
        }
    }

    #[test]
    fn overrides_apply_and_typos_are_named() {
        let config = TrainConfig::preset(Preset::Tiny);
        let changed = config.with(&["warmup.steps=7".into(), "warmup.weights.fill=1".into()]).unwrap();
        assert_eq!((changed.warmup.steps, changed.warmup.weights.fill), (7, 1.0));
        let message = |assignment: &str| config.with(&[assignment.into()]).unwrap_err().to_string();
        assert!(message("warmup.stepps=7").contains("no `stepps`"));
        assert!(message("warmup.steps=x").contains("--set"));
        assert!(message("warmup.steps").contains("key=value"));
    }

    #[test]
    fn the_paper_preset_has_the_papers_numbers() {
        let config = TrainConfig::preset(Preset::Ffhq);
        let (field, stage) = (&config.model.field, &config.field);
        assert_eq!((field.width, field.style_dim, stage.samples, stage.resolution), (128, 256, 24, 64));
        assert_eq!((stage.generator_learning_rate, stage.discriminator_learning_rate), (2e-5, 2e-4));
        assert_eq!((stage.betas, stage.view, stage.eikonal, stage.minimal_surface), ([0.0, 0.9], 15.0, 0.1, 0.001));
        assert_eq!(config.model.upsampler.as_ref().map(|u| u.output_resolution), Some(512));
    }
}
