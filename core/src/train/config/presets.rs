//! The presets' numbers.

use super::{FieldStageConfig, Preset, TrainConfig, UpsamplerStageConfig, WarmupConfig, WarmupWeights};
use crate::{
    config::{FieldConfig, GeneratorConfig, UpsamplerConfig},
    train::optimiser::Schedule,
};

impl TrainConfig {
    /// The settings of a preset.
    pub fn preset(preset: Preset) -> Self {
        match preset {
            Preset::Portrait => {
                let small = Self::small(preset, [0.3, 0.15]);
                // Photos have detail that only a critic asks for; what it spoils on random portraits is held calm.
                let upsampler = UpsamplerStageConfig {
                    perceptual: 1.4,
                    critic: 0.04,
                    calm_background: 2.0,
                    calm_detail: 10.0,
                    calm_outline: 12.0,
                    discriminator_ahead_steps: 30,
                    ..small.upsampler
                };
                Self { upsampler, ..small }
            }
            Preset::Cartoon => Self::small(preset, [0.4, 0.2]),
            Preset::Ffhq => Self::paper(),
            Preset::Tiny => Self::tiny(),
        }
    }

    fn small(preset: Preset, camera_deviation_rad: [f64; 2]) -> Self {
        let field = FieldConfig::ours();
        let upsampler = Some(UpsamplerConfig::ours(field.style_dim));
        Self {
            preset,
            seed: 0,
            mirror: true,
            keep_checkpoints: 2,
            checkpoint_steps: 500,
            sample_steps: 500,
            log_steps: 20,
            model: GeneratorConfig { field, upsampler, camera_deviation_rad, samples: 16, population: 256 },
            warmup: WarmupConfig {
                steps: 16_000,
                batch: 32,
                rays: 48,
                samples: 10,
                depth_range: [0.895, 1.10],
                learning_rate: 1e-3,
                code_learning_rate: 3e-3,
                region_codes_from: 0.55,
                region_code_learning_rate: 1e-2,
                schedule: Schedule { warmup_steps: 100, hold: 0.3, floor: 0.03 },
                betas: [0.9, 0.99],
                gradient_bound: 1.0,
                alpha: [0.012, 0.0024],
                alpha_hold: 0.7,
                resolutions: [32, 64],
                first_resolution_share: 0.4,
                detail_boost: 2.0,
                pixel_jitter: 0.25,
                weights: WarmupWeights {
                    colour: 1.0,
                    masks: 1.0,
                    opacity: 0.1,
                    eikonal: 0.05,
                    minimal_surface: 0.001,
                    fill: 0.1,
                    code_norm: 1e-3,
                    region_code_norm: 1e-2,
                },
                eikonal_share: 1.0 / 6.0,
            },
            field: FieldStageConfig {
                steps: 0,
                batch: 8,
                resolution: 32,
                samples: 12,
                generator_learning_rate: 1e-4,
                discriminator_learning_rate: 1e-3,
                channel_multiplier: 0.125,
                ..Self::paper_field_stage()
            },
            upsampler: UpsamplerStageConfig {
                steps: 3_000,
                batch: 8,
                crop: 48,
                learning_rate: 2e-3,
                discriminator_learning_rate: 1e-3,
                schedule: Schedule { warmup_steps: 50, hold: 0.4, floor: 0.05 },
                betas: [0.9, 0.99],
                pixels: 1.0,
                perceptual: 0.6,
                perceptual_zoom: 2.0,
                critic: 0.0,
                critic_learning_rate: 2e-3,
                adversarial: 0.0,
                adversarial_crop: 64,
                hard_masks: true,
                random_portraits: 1,
                agreement: 1.0,
                calm_background: 1.0,
                calm_detail: 0.0,
                calm_outline: 0.0,
                exchanged_codes: 0.2,
                agreement_turn_rad: 0.5,
                discriminator_ahead_steps: 200,
                channel_multiplier: 0.125,
                r1_image: 1.0,
                r1_mask: 10.0,
                path_length: 0.0,
                average_half_life_images: 1_000.0,
                ..Self::paper_upsampler_stage()
            },
        }
    }

    fn paper() -> Self {
        let field = FieldConfig::paper();
        let upsampler = Some(UpsamplerConfig::paper(field.style_dim));
        let small = Self::small(Preset::Ffhq, [0.3, 0.15]);
        Self {
            model: GeneratorConfig { field, upsampler, camera_deviation_rad: [0.3, 0.15], samples: 24, population: 0 },
            warmup: WarmupConfig { steps: 0, ..small.warmup.clone() },
            field: Self::paper_field_stage(),
            upsampler: Self::paper_upsampler_stage(),
            checkpoint_steps: 2_000,
            sample_steps: 2_000,
            ..small
        }
    }

    fn paper_field_stage() -> FieldStageConfig {
        FieldStageConfig {
            steps: 300_000,
            batch: 24,
            resolution: 64,
            samples: 24,
            generator_learning_rate: 2e-5,
            discriminator_learning_rate: 2e-4,
            betas: [0.0, 0.9],
            channel_multiplier: 1.0,
            r1_image: 10.0,
            r1_mask: 1_000.0,
            view: 15.0,
            eikonal: 0.1,
            minimal_surface: 0.001,
            semantic: 1.0,
            decoupling: 1.0,
            decoupling_margin: 0.1,
            augment_target: 0.0,
            augment_ramp_images: 500_000,
            mixing: 0.9,
            average_half_life_images: 10_000.0,
        }
    }

    fn paper_upsampler_stage() -> UpsamplerStageConfig {
        UpsamplerStageConfig {
            steps: 300_000,
            batch: 16,
            crop: 64,
            learning_rate: 2e-3,
            discriminator_learning_rate: 2e-3,
            schedule: Schedule { warmup_steps: 1, hold: 1.0, floor: 1.0 },
            betas: [0.0, 0.99],
            discriminator_betas: [0.0, 0.99],
            pixels: 0.0,
            perceptual: 0.0,
            perceptual_zoom: 1.0,
            critic: 0.0,
            critic_learning_rate: 5e-4,
            adversarial: 1.0,
            adversarial_crop: 512,
            hard_masks: false,
            random_portraits: 16,
            agreement: 0.0,
            calm_background: 0.0,
            calm_detail: 0.0,
            calm_outline: 0.0,
            exchanged_codes: 0.0,
            agreement_turn_rad: 0.5,
            discriminator_ahead_steps: 0,
            channel_multiplier: 1.0,
            r1_image: 10.0,
            r1_mask: 1_000.0,
            r1_steps: 16,
            augment_target: 0.0,
            augment_ramp_images: 500_000,
            path_length: 2.0,
            path_length_steps: 4,
            average_half_life_images: 10_000.0,
        }
    }

    fn tiny() -> Self {
        let small = Self::small(Preset::Tiny, [0.4, 0.2]);
        let field = FieldConfig { style_dim: 16, width: 16, ..FieldConfig::ours() };
        let upsampler = UpsamplerConfig {
            input_resolution: 16,
            output_resolution: 32,
            channels: vec![8, 8],
            blocks: vec![1, 1],
            ..UpsamplerConfig::ours(16)
        };
        Self {
            checkpoint_steps: 20,
            sample_steps: 40,
            log_steps: 5,
            model: GeneratorConfig { field, upsampler: Some(upsampler), samples: 10, ..small.model },
            warmup: WarmupConfig {
                steps: 120,
                batch: 8,
                rays: 32,
                resolutions: [16, 16],
                learning_rate: 2e-3,
                code_learning_rate: 1e-2,
                schedule: Schedule { warmup_steps: 10, hold: 0.3, floor: 0.05 },
                ..small.warmup
            },
            field: FieldStageConfig {
                steps: 6,
                batch: 2,
                resolution: 16,
                samples: 6,
                channel_multiplier: 0.03125,
                ..small.field
            },
            upsampler: UpsamplerStageConfig {
                steps: 30,
                batch: 4,
                crop: 16,
                perceptual: 0.0,
                agreement: 0.0,
                calm_background: 0.0,
                calm_detail: 0.0,
                calm_outline: 0.0,
                exchanged_codes: 0.0,
                random_portraits: 2,
                ..small.upsampler
            },
            ..small
        }
    }
}
