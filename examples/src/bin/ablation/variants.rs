//! What is compared: every variant is the same small training run with one choice changed.

use cnerf_core::{
    config::{
        Background, Composition, DensityKind, FieldConfig, Fusion, Residual, SdfHead, UpsamplerConfig, UpsamplerStyle,
    },
    train::config::{Preset, Stage, TrainConfig},
};

use crate::Options;

/// One row of the table.
pub struct Variant {
    /// Name in the table, on the command line and of its folder.
    pub name: &'static str,
    /// The stage it is about. Warm-ups begin from fresh weights, the others from the warmed-up model `ours`.
    pub stage: Stage,
    /// What differs from `ours`.
    pub change: fn(&mut TrainConfig),
    /// Whether it has one code for the whole head: an edit of its hair can only change them all.
    pub whole_head: bool,
}

const fn warmup(name: &'static str, change: fn(&mut TrainConfig)) -> Variant {
    Variant { name, stage: Stage::Warmup, change, whole_head: false }
}

const fn adversarial(name: &'static str, change: fn(&mut TrainConfig)) -> Variant {
    Variant { name, stage: Stage::Field, change, whole_head: false }
}

const fn single(name: &'static str, change: fn(&mut TrainConfig)) -> Variant {
    Variant { whole_head: true, ..warmup(name, change) }
}

/// All variants; `ours` first, as others start from it.
pub const VARIANTS: &[Variant] = &[
    warmup("ours", |_| ()),
    // Each choice of design.md §4 in the paper's form, the others in ours.
    warmup("sdf_head=texture", |config| config.model.field.sdf_head = SdfHead::Texture),
    warmup("residual=sum", |config| config.model.field.residual = Residual::Sum),
    warmup("fusion=raw", |config| config.model.field.fusion = Fusion::Raw),
    warmup("background=field", |config| config.model.field.background = Background::Field),
    // Gated residuals forbid masks that see the view, so this one sums them as well.
    warmup("residual=sum, mask_view", |config| {
        config.model.field.residual = Residual::Sum;
        config.model.field.mask_view_input = true;
    }),
    warmup("feature_view", |config| config.model.field.feature_view_input = true),
    warmup("paper", |config| {
        let FieldConfig { style_dim, width, .. } = config.model.field;
        config.model.field = FieldConfig { style_dim, width, ..FieldConfig::paper() };
    }),
    // The paper's figure of residual SDF, direct SDF and density.
    warmup("direct sdf", |config| config.model.field.density = DensityKind::Sdf),
    warmup("density", density),
    warmup("paper, direct sdf", |config| {
        let FieldConfig { style_dim, width, .. } = config.model.field;
        config.model.field = FieldConfig { style_dim, width, density: DensityKind::Sdf, ..FieldConfig::paper() };
    }),
    single("single network", |config| config.model.field.composition = Composition::Single),
    single("single network, 2x width", |config| {
        config.model.field.composition = Composition::Single;
        config.model.field.width *= 2;
    }),
    adversarial("adversarial", |_| ()),
    adversarial("no semantic", |config| config.field.semantic = 0.0),
    adversarial("no L_STD", |config| config.field.decoupling = 0.0),
    adversarial("no semantic, no L_STD", |config| (config.field.semantic, config.field.decoupling) = (0.0, 0.0)),
    Variant { name: "style=per_region", stage: Stage::Upsampler, change: |_| (), whole_head: false },
    Variant {
        name: "style=global",
        stage: Stage::Upsampler,
        change: |config| {
            if let Some(upsampler) = &mut config.model.upsampler {
                upsampler.style = UpsamplerStyle::Global;
            }
        },
        whole_head: false,
    },
];

/// Heads that sum to a density have no distance for the losses on distances to shape.
fn density(config: &mut TrainConfig) {
    config.model.field.density = DensityKind::Density;
    (config.warmup.weights.eikonal, config.warmup.weights.minimal_surface) = (0.0, 0.0);
}

impl Variant {
    /// The run of this variant.
    pub fn config(&self, options: &Options) -> TrainConfig {
        let mut config = ours(options);
        if self.stage == Stage::Upsampler {
            config.model.upsampler = Some(UpsamplerConfig {
                input_resolution: options.size / 2,
                output_resolution: options.size,
                channels: vec![16, 16],
                blocks: vec![1, 1],
                ..UpsamplerConfig::ours(options.style)
            });
        }
        (self.change)(&mut config);
        config
    }
}

/// Our form, small, with short schedules.
fn ours(options: &Options) -> TrainConfig {
    let mut config = TrainConfig { seed: options.seed, ..TrainConfig::preset(Preset::Cartoon) };
    config.model.field = FieldConfig { style_dim: options.style, width: options.width, ..FieldConfig::ours() };
    config.model.upsampler = None;
    let (half, whole) = (options.size / 2, options.size);
    let warmup = &mut config.warmup;
    (warmup.steps, warmup.resolutions) = (options.warmup_steps, [half, whole]);
    (warmup.batch, warmup.rays, warmup.samples) = (16, 32, 8);
    (warmup.learning_rate, warmup.code_learning_rate) = (2e-3, 1e-2);
    warmup.schedule.warmup_steps = 30;
    let field = &mut config.field;
    (field.steps, field.batch, field.resolution, field.samples) = (options.field_steps, 4, half, 10);
    // What averages over 10,000 pictures would still be where it began.
    (field.generator_learning_rate, field.average_half_life_images) = (3e-4, 40.0);
    let upsampler = &mut config.upsampler;
    (upsampler.steps, upsampler.batch, upsampler.crop) = (options.upsampler_steps, 4, half);
    (upsampler.perceptual, upsampler.agreement, upsampler.random_portraits) = (0.0, 0.0, 0);
    (upsampler.calm_background, upsampler.calm_detail, upsampler.exchanged_codes) = (0.0, 0.0, 0.0);
    upsampler.average_half_life_images = 100.0;
    config
}
