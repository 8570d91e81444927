//! Pivotal tuning (Roich et al., 2021) with the geometry held: the generator's weights move until the frozen pivot
//! shows the photo, while
//! - pictures at nearby codes stay those of the original generator (locality), so that edits still work, and
//! - depth and masks at views the photo does not show stay the pivot's, so that the face is not flattened onto the photo.
//!
//! Texture layers, colour and feature heads and the upsampler move freely, shape layers slowly. The affine maps from
//! codes to FiLM keep their weights: around one frozen code only their biases matter, at a hundredth of the numbers.

use std::collections::BTreeMap;

use candle_core::{Tensor, Var};
use cnerf_core::{
    camera::Camera,
    model::{file::Tensors, generator::Generator},
    render::RenderSettings,
    rng::Stream,
    train::optimiser::{Adam, Betas, Group, Schedule},
};

use crate::{
    checkpoint::{self, TuneState},
    config::{InvertConfig, PivotConfig, Steps, TuneConfig},
    error::Result,
    events::StepReport,
    objective::{self, Loss, PhotoWeights, Target},
    pivot::{whole_loss, whole_picture},
    space::CodeSpace,
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x7475_6e65;
/// Rays of one off-view's depth term and of one locality term.
const SIDE_RAYS: usize = 384;
/// One unit of the depth term, world units: a face is about ten of these deep.
const DEPTH_UNIT: f64 = 0.01;
const SCHEDULE: Schedule = Schedule { warmup_steps: 3, hold: 0.5, floor: 0.1 };
/// A loss must fall below this share of the best one to count as progress.
const PROGRESS: f64 = 0.999;
/// Steps over which the loss is averaged before it is judged.
const SMOOTHING: f64 = 8.0;

/// A portrait that tuning leaves as it is.
pub struct Frozen {
    /// `[1, 9, 2, D]`.
    pub codes: Tensor,
    /// The upsampler's global code `[1, D]`, if it has one.
    pub global: Option<Tensor>,
    /// The cameras that see the photos, one each.
    pub cameras: Vec<Camera>,
}

/// The running optimisation.
pub struct Tune {
    config: TuneConfig,
    weights: PhotoWeights,
    steps: Steps,
    seed: u64,
    generator: Generator,
    frozen: Frozen,
    /// One a photo, `[1, 6]`.
    cameras: Vec<Tensor>,
    off_views: Vec<OffView>,
    optimiser: Adam,
    step: usize,
    progress: Progress,
    best: Option<Best>,
}

/// The weights that showed the photo best so far.
struct Best {
    loss: f64,
    weights: BTreeMap<String, Tensor>,
}

/// Whether a noisy loss still falls.
struct Progress {
    smoothed: Option<f64>,
    lowest: f64,
    since_lowest: usize,
}

impl Progress {
    fn add(&mut self, loss: f64) {
        let smoothed = self.smoothed.map_or(loss, |smoothed| smoothed + (loss - smoothed) / SMOOTHING);
        self.smoothed = Some(smoothed);
        if smoothed < PROGRESS * self.lowest {
            (self.lowest, self.since_lowest) = (smoothed, 0);
        } else {
            self.since_lowest += 1;
        }
    }
}

/// A view the photo does not show, and the pivot there.
struct OffView {
    camera: Tensor,
    /// `[1, 1, r, r]`, world units.
    depth: Tensor,
    /// `[1, 9, r, r]`.
    masks: Tensor,
}

impl Tune {
    /// Tunes a copy of `original`.
    pub fn new(original: &Generator, frozen: Frozen, config: &InvertConfig) -> Result<Self> {
        let generator = original.duplicate()?;
        let cameras = frozen.cameras.iter();
        let cameras = cameras.map(|camera| Ok(Camera::parameter_tensor(&[*camera], &generator.device())?));
        let cameras = cameras.collect::<Result<Vec<_>>>()?;
        let off_views = frozen
            .cameras
            .iter()
            .flat_map(|camera| off_views(camera, config.tune.off_view_rad))
            .map(|view| {
                let camera = Camera::parameter_tensor(&[view], &generator.device())?;
                let (depth, masks) = depth_and_masks(original, &frozen.codes, &camera)?;
                Ok(OffView { camera, depth, masks })
            })
            .collect::<Result<_>>()?;
        let PivotConfig { absolute, squared, perceptual, masks, opacity, .. } = config.pivot;
        let (texture, geometry) = tunable(&generator);
        let group = |variables, learning_rate| Group { variables, learning_rate, largest_gradient_norm: None };
        let groups = vec![group(texture, config.tune.texture_rate), group(geometry, config.tune.geometry_rate)];
        Ok(Self {
            config: config.tune.clone(),
            weights: PhotoWeights { absolute, squared, perceptual, masks, opacity },
            steps: config.steps(),
            seed: config.seed,
            generator,
            frozen,
            cameras,
            off_views,
            optimiser: Adam::new(groups, Betas { first: 0.9, second: 0.99 }),
            step: 0,
            progress: Progress { smoothed: None, lowest: f64::INFINITY, since_lowest: 0 },
            best: None,
        })
    }

    /// Whether all steps are done.
    pub fn is_done(&self) -> bool {
        self.step >= self.steps.tune
    }

    /// Whether the loss no longer falls.
    pub fn is_settled(&self) -> bool {
        self.progress.since_lowest >= self.config.patience
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.step
    }

    /// Adds all that steps have changed to a checkpoint's tensors, and says the rest.
    pub(crate) fn save(&self, tensors: &mut Tensors) -> Result<TuneState> {
        checkpoint::put_all(tensors, "tune.weight", tuned_weights(&self.generator)?);
        if let Some(best) = &self.best {
            checkpoint::put_all(tensors, "tune.best", best.weights.clone());
        }
        self.optimiser.save("tune.adam", tensors)?;
        let Progress { smoothed, lowest, since_lowest } = self.progress;
        Ok(TuneState {
            steps: self.step,
            smoothed,
            lowest: lowest.is_finite().then_some(lowest),
            since_lowest,
            best_loss: self.best.as_ref().map(|best| best.loss),
        })
    }

    /// Goes back to where [`Self::save`] was called.
    pub(crate) fn restore(&mut self, state: &TuneState, tensors: &Tensors) -> Result<()> {
        self.generator.parameters().restore(&checkpoint::all_of(tensors, "tune.weight"))?;
        self.optimiser.load("tune.adam", tensors)?;
        self.step = state.steps;
        let lowest = state.lowest.unwrap_or(f64::INFINITY);
        self.progress = Progress { smoothed: state.smoothed, lowest, since_lowest: state.since_lowest };
        self.best = state.best_loss.map(|loss| Best { loss, weights: checkpoint::all_of(tensors, "tune.best") });
        Ok(())
    }

    /// One step; `original` is the generator tuning began with, `targets` are as many as there are cameras.
    pub fn step(&mut self, original: &Generator, space: &CodeSpace, targets: &[Target]) -> Result<StepReport> {
        let mut random = Stream::new(self.seed, &[STREAM, self.step as u64]);
        let photo = self.photo_loss(self.step, targets, true)?;
        let psnr = photo.psnr();
        let photo_loss = objective::scalar(&photo.total)?;
        let mut total = (photo.total + self.off_view_loss(&mut random)?)?;
        if self.config.locality > 0.0 && self.step.is_multiple_of(self.config.locality_every.max(1)) {
            total = (total + (self.locality_loss(original, space, &mut random)? * self.config.locality)?)?;
        }
        let value = objective::scalar(&total)?;
        if !value.is_finite() {
            return Err(cnerf_core::Error::not_finite("the tuning's loss").into());
        }
        // Judged by the photo alone: the other terms are drawn anew every step. Photos differ in how well they can be
        // shown: with several, weights are compared where all have had their turn.
        self.progress.add(photo_loss);
        if self.step.is_multiple_of(self.cameras.len().max(1)) {
            let all = self.all_photos(targets, (self.cameras.len() == 1).then_some(photo_loss))?;
            self.keep_if_best(all)?;
        }
        self.optimiser.step(&total.backward()?, SCHEDULE.factor(self.step, self.steps.tune))?;
        self.step += 1;
        Ok(StepReport { step: self.step, total: self.steps.tune, loss: value, psnr })
    }

    /// The weights that showed the photo best, of all steps and the last one's outcome, by name. Never worse at that
    /// than the pivot: the first step saw its weights.
    pub fn best_weights(&mut self, targets: &[Target]) -> Result<BTreeMap<String, Tensor>> {
        let loss = self.all_photos(targets, None)?;
        self.keep_if_best(loss)?;
        Ok(self.best.take().map(|best| best.weights).unwrap_or_default())
    }

    /// The loss of the photo whose turn `turn` is.
    fn photo_loss(&self, turn: usize, targets: &[Target], differentiable: bool) -> Result<Loss> {
        let index = turn % self.cameras.len().max(1);
        let (Some(target), Some(camera)) = (targets.get(index), self.cameras.get(index)) else {
            return Err(cnerf_core::Error::shape("photos", [self.cameras.len()], &[targets.len()]).into());
        };
        let Frozen { codes, global, .. } = &self.frozen;
        let picture = whole_picture(&self.generator, codes, global.as_ref(), camera, differentiable)?;
        whole_loss(&picture, target, &self.weights)
    }

    /// The sum of all photos' losses with the weights as they are; `known` if it is known already.
    fn all_photos(&self, targets: &[Target], known: Option<f64>) -> Result<f64> {
        match known {
            Some(loss) => Ok(loss),
            None => (0..targets.len())
                .map(|turn| objective::scalar(&self.photo_loss(turn, targets, false)?.total))
                .sum::<Result<f64>>(),
        }
    }

    fn keep_if_best(&mut self, loss: f64) -> Result<()> {
        if self.best.as_ref().is_none_or(|best| loss < best.loss) {
            self.best = Some(Best { loss, weights: tuned_weights(&self.generator)? });
        }
        Ok(())
    }

    /// How far depth and masks are from the pivot's on random rays of one off-view, weighted.
    fn off_view_loss(&self, random: &mut Stream) -> Result<Tensor> {
        let device = self.generator.device();
        let TuneConfig { depth, masks, .. } = self.config;
        let view = random.pick(&self.off_views).filter(|_| depth > 0.0 || masks > 0.0);
        let Some(view) = view else { return Ok(Tensor::zeros((), candle_core::DType::F32, &device)?) };
        let settings = self.generator.render_settings();
        let pixels = objective::draw_pixels(settings.resolution, SIDE_RAYS, random, &device)?;
        let field = self.generator.field().portraits(&self.frozen.codes)?;
        // Regular samples, as the pivot's depth was rendered with: only the weights' change may count.
        let output =
            objective::render_regular_pixels(&field, &view.camera, &pixels, settings.resolution, &settings.sampling)?;
        let wanted = view.depth.flatten_from(1)?.index_select(&pixels, 1)?;
        let off = ((output.depth - wanted)? / DEPTH_UNIT)?.sqr()?.mean_all()?;
        let wanted = view.masks.flatten_from(2)?.index_select(&pixels, 2)?;
        let moved = (output.masks - wanted)?.sqr()?.sum(1)?.mean_all()?;
        Ok(((off * depth)? + (moved * masks)?)?)
    }

    /// Mean squared change of colours and masks on random rays of a portrait near the pivot.
    fn locality_loss(&self, original: &Generator, space: &CodeSpace, random: &mut Stream) -> Result<Tensor> {
        let device = self.generator.device();
        let settings = self.generator.render_settings();
        let nearby = space.near(&self.frozen.codes, self.config.locality_distance, random)?;
        let pixels = objective::draw_pixels(settings.resolution, SIDE_RAYS, random, &device)?;
        let camera = Camera::at(
            f64::from(random.normal()) * original.config().camera_deviation_rad[0],
            f64::from(random.normal()) * original.config().camera_deviation_rad[1],
        );
        let camera = Camera::parameter_tensor(&[camera], &device)?;
        let render = |generator: &Generator| -> Result<_> {
            let field = generator.field().portraits(&nearby)?;
            objective::render_regular_pixels(&field, &camera, &pixels, settings.resolution, &settings.sampling)
        };
        let (wanted, found) = (render(original)?, render(&self.generator)?);
        let colour = (found.colour - wanted.colour.detach())?.sqr()?.mean_all()?;
        let masks = (found.masks - wanted.masks.detach())?.sqr()?.sum(1)?.mean_all()?;
        Ok((colour + masks)?)
    }

    /// Mean absolute difference between the depth of `generator` and the pivot's over all off-views, world units.
    pub fn depth_drift(&self, generator: &Generator) -> Result<f64> {
        let mut sum = 0.0;
        for view in &self.off_views {
            let (found, _) = depth_and_masks(generator, &self.frozen.codes, &view.camera)?;
            sum += objective::scalar(&(found - &view.depth)?.abs()?.mean_all()?)?;
        }
        Ok(sum / self.off_views.len().max(1) as f64)
    }
}

/// A photo's camera turned to both sides.
fn off_views(camera: &Camera, turn_rad: f64) -> [Camera; 2] {
    [-turn_rad, turn_rad].map(|turn| Camera { azimuth_rad: camera.azimuth_rad + turn, ..*camera })
}

/// Depth `[1, 1, r, r]`, world units, and masks `[1, 9, r, r]`.
fn depth_and_masks(generator: &Generator, codes: &Tensor, camera: &Tensor) -> Result<(Tensor, Tensor)> {
    // Exact, as the samples of `Tune::off_view_loss` are: drift must not count what a plan leaves out.
    let settings = RenderSettings { features: false, normals: false, budget: 0.0, ..generator.render_settings() };
    let frame = generator.render(codes, camera, &settings)?;
    Ok((frame.depth.detach(), frame.masks.detach()))
}

type Variables = Vec<(String, Var)>;

/// Weights that tuning moves: those that make texture, and those that make shape.
fn tunable(generator: &Generator) -> (Variables, Variables) {
    const TEXTURE: [&str; 6] =
        ["field.weight4", "field.weight5", "field.bias4", "field.bias5", "field.feature.", "field.colour."];
    const GEOMETRY: [&str; 9] = [
        "field.weight1",
        "field.weight2",
        "field.weight3",
        "field.bias1",
        "field.bias2",
        "field.bias3",
        "field.mask.",
        "field.residual.",
        "field.film.bias",
    ];
    let starts = |name: &str, prefixes: &[&str]| prefixes.iter().any(|prefix| name.starts_with(prefix));
    let all = generator.parameters().variables();
    let texture = all
        .iter()
        .filter(|(name, _)| starts(name, &TEXTURE) || (name.starts_with("upsampler.") && !name.ends_with(".noise")));
    let geometry = all.iter().filter(|(name, _)| starts(name, &GEOMETRY));
    (texture.cloned().collect(), geometry.cloned().collect())
}

/// The values of all weights that tuning moves, by name.
fn tuned_weights(generator: &Generator) -> Result<BTreeMap<String, Tensor>> {
    let (texture, geometry) = tunable(generator);
    texture.into_iter().chain(geometry).map(|(name, weight)| Ok((name, weight.as_tensor().copy()?.detach()))).collect()
}
