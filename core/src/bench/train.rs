//! Training steps: forward and backward on the fused kernels against candle's own operations, their speed, their memory
//! and how exact their gradients are.

use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::{
    bench::{
        Machine,
        measure::{Timing, Way, in_turns, relative_l2},
    },
    camera::{self, Camera},
    config::{Background, GeneratorConfig},
    data::{
        cartoon::{RenderOptions, SynthOptions, synth},
        dataset::{Dataset, DatasetWriter, EncodedItem, PhotoFormat},
        labels::LabelMap,
        picture::RgbImage,
    },
    error::{Error, Result},
    interop::chart::{Group, GroupedBars},
    kernels::{Outputs, Path},
    model::field::Field,
    parameters::Parameters,
    region::{REGION_COUNT, RegionSet},
    render::{RayBundle, Sampling, render_rays},
    rng::Stream,
    train::{
        config::{Preset, Stage, TrainConfig},
        events::Metrics,
        field_stage::FieldStage,
        losses,
        team::Team,
        trainer::{Inputs, StageRun},
        warmup::Warmup,
    },
};

/// A step that is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "snake_case")]
pub enum Step {
    /// A picture against a target, back to codes, camera and all weights of the field: what inversion does.
    Pivot,
    /// The generator's half of adversarial training, all losses.
    Generator,
    /// A whole step of adversarial training: discriminators with R1, generator, optimisers.
    Training,
}

impl Step {
    /// The name in reports and options.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pivot => "pivot",
            Self::Generator => "generator",
            Self::Training => "training",
        }
    }
}

/// How large the steps are.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sizes {
    /// Whose networks.
    pub preset: Preset,
    /// Pictures a step.
    pub batch: usize,
    /// Width and height of a render, pixels.
    pub resolution: usize,
    /// Samples a ray.
    pub samples: usize,
}

impl Sizes {
    /// The preset's own, in its adversarial stage.
    pub fn of(preset: Preset) -> Self {
        let stage = TrainConfig::preset(preset).field;
        Self { preset, batch: stage.batch, resolution: stage.resolution, samples: stage.samples }
    }

    /// The authors' sizes, one picture at a time.
    pub fn reference() -> Self {
        Self { batch: 1, ..Self::of(Preset::Ffhq) }
    }

    fn config(&self) -> TrainConfig {
        let mut config = TrainConfig::preset(self.preset);
        config.field.batch = self.batch;
        config.field.resolution = self.resolution;
        config.field.samples = self.samples;
        config
    }

    fn sampling(&self) -> Sampling {
        match self.config().model.field.background {
            Background::Field => Sampling::closed(self.samples),
            Background::FarPlane => Sampling::behind_the_surface(self.samples),
        }
    }

    /// About how much memory a step takes as candle's graph, bytes: every operation keeps its result until the backward
    /// pass. In tensors of all points, regions and units: measured at small sizes.
    pub fn composed_bytes(&self, step: Step) -> f64 {
        let points = (self.batch * self.resolution * self.resolution * self.samples) as f64;
        let width = self.config().model.field.width as f64;
        let tensor = points * REGION_COUNT as f64 * width * 4.0;
        match step {
            Step::Pivot => 30.0 * tensor,
            // One render with ∇d, and four for L_STD.
            Step::Generator | Step::Training => 120.0 * tensor,
        }
    }
}

/// One step on both paths.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// Which.
    pub step: Step,
    /// Seconds of candle's operations, if they fit into the memory there is.
    pub plain_seconds_per_image: Option<f64>,
    /// Seconds of the fused kernels.
    pub fused_seconds_per_image: f64,
    /// How many times faster the fused kernels are.
    pub speedup: Option<f64>,
    /// The most memory a process of its own held during the step on the fused kernels, bytes.
    pub peak_rss_bytes: Option<u64>,
    /// The same on candle's operations.
    pub plain_peak_rss_bytes: Option<u64>,
    /// Spread of the fused measurements.
    pub fused: Timing,
    /// Spread of the plain ones.
    pub plain: Option<Timing>,
}

/// How far f32 is from f64, relative L2, at the rays of a coarse grid.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Exactness {
    /// Pictures and masks of the fused kernels.
    pub value_rel_error: f64,
    /// Gradients of the fused kernels: the worst of codes, cameras and weights.
    pub gradient_rel_error: f64,
    /// Pictures and masks of candle's operations in f32.
    pub plain_value_rel_error: f64,
    /// Gradients of candle's operations in f32.
    pub plain_gradient_rel_error: f64,
}

/// Times `step` on `fused` and, with `plain`, on candle's operations in turns.
pub fn time(step: Step, sizes: &Sizes, fused: Path, plain: bool, repeats: usize) -> Result<StepReport> {
    let mut runners = vec![Runner::new(step, sizes, fused)?];
    if plain {
        runners.push(Runner::new(step, sizes, Path::Composed)?);
    }
    let mut ways: Vec<Way<'_>> = runners.iter_mut().map(|runner| -> Way<'_> { Box::new(|| runner.run()) }).collect();
    let timings = in_turns(repeats, &mut ways)?;
    let seconds = |timing: &Timing| timing.median_seconds / sizes.batch as f64;
    let own = timings.first().copied().unwrap_or_else(|| Timing::of(Vec::new()));
    let other = timings.get(1).copied();
    Ok(StepReport {
        step,
        plain_seconds_per_image: other.as_ref().map(seconds),
        fused_seconds_per_image: seconds(&own),
        speedup: other.map(|other| other.median_seconds / own.median_seconds),
        peak_rss_bytes: None,
        plain_peak_rss_bytes: None,
        fused: own,
        plain: other,
    })
}

/// Does `step` once on `path`: for a process whose memory is watched.
pub fn once(step: Step, sizes: &Sizes, path: Path) -> Result<()> {
    Runner::new(step, sizes, path)?.run()
}

/// A step that can be repeated.
struct Runner {
    path: Path,
    work: Work,
    /// What the stages' loaders read from.
    _portraits: Option<Portraits>,
}

enum Work {
    Pivot(Box<Pivot>),
    Generator(Box<FieldStage>),
    Training { stage: Box<FieldStage>, next: usize },
}

impl Runner {
    fn new(step: Step, sizes: &Sizes, path: Path) -> Result<Self> {
        if step == Step::Pivot {
            return Ok(Self { path, work: Work::Pivot(Box::new(Pivot::new(sizes, 1)?)), _portraits: None });
        }
        let portraits = Portraits::draw(2 * sizes.batch, sizes.resolution)?;
        let stage = Box::new(FieldStage::new(&sizes.config(), &portraits.inputs(), None)?);
        let work = match step {
            Step::Training => Work::Training { stage, next: 0 },
            _ => Work::Generator(stage),
        };
        Ok(Self { path, work, _portraits: Some(portraits) })
    }

    fn run(&mut self) -> Result<()> {
        let work = &mut self.work;
        self.path.run(|| match work {
            Work::Pivot(pivot) => pivot.answer(DType::F32).map(drop),
            Work::Generator(stage) => stage.generator_gradients(0, &mut Metrics::default()).map(drop),
            Work::Training { stage, next } => {
                *next += 1;
                stage.step(*next - 1).map(drop)
            }
        })
    }
}

/// A render against a random target.
struct Pivot {
    config: GeneratorConfig,
    sizes: Sizes,
    /// Every so many-th pixel each way.
    stride: usize,
}

/// Values of a step, gradients of codes, cameras and weights.
struct Answer {
    values: Vec<f64>,
    gradients: [Vec<f64>; 3],
}

impl Pivot {
    fn new(sizes: &Sizes, stride: usize) -> Result<Self> {
        if stride == 0 || sizes.resolution == 0 || sizes.batch == 0 || sizes.samples == 0 {
            return Err(Error::config("bench train", "batch, resolution and samples must be at least 1"));
        }
        let mut config = GeneratorConfig { upsampler: None, ..sizes.config().model };
        // A surface to render: at the paper's first α of 0.1 everything is fog.
        config.field.alpha_initial = config.field.alpha_initial.min(0.02);
        Ok(Self { config, sizes: sizes.clone(), stride })
    }

    fn answer(&self, dtype: DType) -> Result<Answer> {
        let device = Device::Cpu;
        let batch = self.sizes.batch;
        let parameters = Parameters::fresh(3, DType::F32, &device);
        Field::new(&self.config.field, &parameters)?;
        let parameters = Parameters::loaded(parameters.snapshot()?.into_iter().collect(), dtype, &device);
        let field = Field::new(&self.config.field, &parameters)?;
        let mut random = Stream::new(4, &[]);
        let shape = [batch, REGION_COUNT, 2, self.config.field.style_dim];
        let codes = candle_core::Var::from_tensor(&random.normal_tensor(&shape, &device)?.to_dtype(dtype)?)?;
        let cameras: Vec<_> = (0..batch).map(|index| Camera::at(0.2 + 0.1 * index as f64, -0.1)).collect();
        let cameras = Camera::parameter_tensor(&cameras, &device)?.to_dtype(dtype)?;
        let cameras = candle_core::Var::from_tensor(&cameras)?;

        let resolution = self.sizes.resolution;
        let chosen: Vec<u32> = (0..resolution * resolution)
            .filter(|pixel| {
                (pixel % resolution).is_multiple_of(self.stride) && (pixel / resolution).is_multiple_of(self.stride)
            })
            .map(|pixel| pixel as u32)
            .collect();
        let count = chosen.len();
        let pixels = camera::pixel_centres(resolution, &device)?.to_dtype(dtype)?;
        let pixels = pixels.index_select(&Tensor::from_vec(chosen, count, &device)?, 1)?;
        let sampling = self.sizes.sampling();
        let rays = RayBundle::new(camera::cast(&cameras, &pixels, resolution, camera::FIELD_OF_VIEW_RAD)?)?;
        let depths = sampling.regular(DType::F32, &device)?.to_dtype(dtype)?;
        let outputs = Outputs { colour: true, ..Outputs::default() };
        let output = render_rays(&field.portraits(&codes)?, &rays, &depths, &sampling, outputs, RegionSet::ALL)?;

        let target = |random: &mut Stream, rows: usize| -> Result<Tensor> {
            Ok(random.normal_tensor(&[batch, rows, count], &device)?.to_dtype(dtype)?)
        };
        let colour = losses::colour_l2(&output.colour, &target(&mut random, 3)?)?;
        let masks = losses::masks_l2(&output.masks, &target(&mut random, REGION_COUNT)?, &[1.0; REGION_COUNT])?;
        let gradients = (colour + masks)?.backward()?;
        let gradient = |variable: &candle_core::Var| match gradients.get(variable) {
            Some(gradient) => values(gradient),
            None => Ok(vec![0.0; variable.elem_count()]),
        };
        let mut weights = Vec::with_capacity(parameters.count());
        for (_, variable) in parameters.variables() {
            weights.extend(gradient(&variable)?);
        }
        let mut pictures = values(&output.colour)?;
        pictures.extend(values(&output.masks)?);
        Ok(Answer { values: pictures, gradients: [gradient(&codes)?, gradient(&cameras)?, weights] })
    }
}

fn values(tensor: &Tensor) -> Result<Vec<f64>> {
    Ok(tensor.detach().to_dtype(DType::F64)?.flatten_all()?.to_vec1()?)
}

/// How far f32 is from f64 at a picture of these sizes, of which at most 8 × 8 pixels are computed.
pub fn exactness(sizes: &Sizes, fused: Path) -> Result<Exactness> {
    let pivot = Pivot::new(sizes, sizes.resolution.div_ceil(8).max(1))?;
    let exact = pivot.answer(DType::F64)?;
    let errors = |path: Path| -> Result<(f64, f64)> {
        let found = path.run(|| pivot.answer(DType::F32))?;
        let gradients = found.gradients.iter().zip(&exact.gradients).map(|(found, exact)| relative_l2(found, exact));
        Ok((relative_l2(&found.values, &exact.values), gradients.fold(0.0, f64::max)))
    };
    let ((value_rel_error, gradient_rel_error), (plain_value_rel_error, plain_gradient_rel_error)) =
        (errors(fused)?, errors(Path::Composed)?);
    Ok(Exactness { value_rel_error, gradient_rel_error, plain_value_rel_error, plain_gradient_rel_error })
}

/// What `stage` measures in each of its first `steps` steps on `path`, from the same start and the same draws on any path.
pub fn trajectory(preset: Preset, stage: Stage, steps: usize, path: Path) -> Result<Vec<Metrics>> {
    let config = TrainConfig::preset(preset);
    // First codes are principal components: they need more portraits than they have numbers.
    let count = config.warmup.batch.max(2 * config.field.batch).max(config.model.field.style_dim + 1);
    let portraits = Portraits::draw(count, 64)?;
    let inputs = portraits.inputs();
    path.run(|| {
        let mut run: Box<dyn StageRun> = match stage {
            Stage::Warmup => Box::new(Warmup::new(&config, &inputs, None)?),
            Stage::Field => Box::new(FieldStage::new(&config, &inputs, None)?),
            _ => return Err(Error::config("stage", "trajectories are of warmup or field")),
        };
        (0..steps).map(|step| run.step(step)).collect()
    })
}

/// Cartoon portraits in a folder that is gone when this is.
struct Portraits {
    dataset: Arc<Dataset>,
    _folder: tempfile::TempDir,
}

impl Portraits {
    fn draw(count: usize, size: usize) -> Result<Self> {
        let folder = tempfile::tempdir().map_err(|error| Error::io(std::env::temp_dir(), error))?;
        let path = folder.path().join("portraits");
        let mut writer = DatasetWriter::create(&path, false)?;
        for item in synth(1, SynthOptions { count, size, ..SynthOptions::default() }, RenderOptions::default())? {
            let side = item.picture.size as u32;
            let image = RgbImage::from_raw(side, side, item.picture.rgb)
                .ok_or_else(|| Error::shape("picture", [side, side, 3], &[]))?;
            let labels = LabelMap::new(side, side, item.picture.labels)?;
            writer.add(EncodedItem::new(&image, Some(&labels), Some(item.camera), PhotoFormat::Png)?)?;
        }
        writer.finish()?;
        Ok(Self { dataset: Arc::new(Dataset::open(&path)?), _folder: folder })
    }

    fn inputs(&self) -> Inputs {
        Inputs {
            dataset: Arc::clone(&self.dataset),
            perceptual: None,
            start: None,
            device: Device::Cpu,
            team: Team::default(),
        }
    }
}

/// Time and memory of every step as bars: (file name, SVG).
pub fn charts(
    steps: &[StepReport],
    fused: Path,
    sizes: &Sizes,
    machine: &Machine,
) -> Result<Vec<(&'static str, String)>> {
    let Sizes { preset, batch, resolution, samples } = sizes;
    let subtitle =
        format!("{} · {resolution}×{resolution} rays of {samples} samples, batch {batch}", machine.describe());
    let title = format!("Training steps, {preset:?} networks");
    let group = |step: &StepReport, fused_value: Option<f64>, plain_value: Option<f64>| {
        let fused_bar = fused_value.map(|value| (format!("fused ({})", fused.name()), value));
        let plain_bar = plain_value.map(|value| ("candle's operations".to_owned(), value));
        Group { label: step.step.name().to_owned(), bars: fused_bar.into_iter().chain(plain_bar).collect() }
    };
    let gib = |bytes: Option<u64>| bytes.map(|bytes| bytes as f64 / f64::from(1 << 30));
    let seconds: Vec<_> = steps
        .iter()
        .map(|step| group(step, Some(step.fused_seconds_per_image), step.plain_seconds_per_image))
        .collect();
    let memory: Vec<_> =
        steps.iter().map(|step| group(step, gib(step.peak_rss_bytes), gib(step.plain_peak_rss_bytes))).collect();
    let bars = |unit: &str, groups: &[Group]| {
        GroupedBars { title: &title, subtitle: &subtitle, unit, groups, limits: &[] }.svg()
    };
    Ok(vec![
        (CHARTS[0], bars("seconds an image; shorter is faster", &seconds)?),
        (CHARTS[1], bars("GiB a process of its own held at most", &memory)?),
    ])
}

/// The charts' file names.
pub const CHARTS: [&str; 2] = ["train_seconds.svg", "train_memory.svg"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_runs_on_both_paths() {
        let sizes = Sizes { batch: 1, samples: 4, ..Sizes::of(Preset::Tiny) };
        for step in [Step::Pivot, Step::Generator, Step::Training] {
            let report = time(step, &sizes, Path::fastest(), true, 1).unwrap();
            assert!(report.fused_seconds_per_image > 0.0 && report.speedup.unwrap() > 0.0, "{report:?}");
        }
    }

    #[test]
    fn gradients_of_a_whole_picture_are_as_exact_as_f32_allows() {
        let sizes = Sizes { batch: 2, ..Sizes::of(Preset::Tiny) };
        for path in Path::available() {
            let found = exactness(&sizes, path).unwrap();
            assert!(found.value_rel_error <= 1e-5 && found.gradient_rel_error <= 1e-4, "{path:?} {found:?}");
        }
    }

    /// The same losses on every path for twenty steps. Rounding differs by about 1e-6 of a gradient a step; Adam divides
    /// by the gradient's size, so where a gradient is itself rounding noise its step is not: 2 % is what that leaves.
    /// Gradient norms, which amplify it (3 % between plain loops and candle at step 19 of `field`), may differ by 10 %.
    #[test]
    fn training_follows_the_same_trajectory_on_every_path() {
        for stage in [Stage::Warmup, Stage::Field] {
            let run = |path| trajectory(Preset::Tiny, stage, 20, path).unwrap();
            let expected = run(Path::Composed);
            for path in Path::available().filter(|path| path.name() != "composed") {
                for (step, (found, expected)) in run(path).iter().zip(&expected).enumerate() {
                    for ((name, found), (_, expected)) in found.0.iter().zip(&expected.0) {
                        let error = (found - expected).abs() / (expected.abs() + 1e-3);
                        let is_gradient = ["gradient_norm", "generator_norm", "discriminator_norm"].contains(name);
                        let bound = if is_gradient { 0.1 } else { 0.02 };
                        assert!(error < bound, "{stage:?} on {path:?}, step {step}: {name} {found} and not {expected}");
                    }
                }
            }
        }
    }
}
