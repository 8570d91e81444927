//! Plans that skip: pictures for looking at, rendered under a budget of error (design: "Skip what a scene does not
//! need").
//!
//! A plan runs in stages over chunks of rays. The shape branches come first, front to back, and end a ray where what is
//! left of its light cannot matter; space that the branches of some regions already prove empty costs no others
//! ([`march`]). That fixes how much of its pixel every (sample, region) pair can change;
//! texture branches run only for pairs whose largest possible effects, summed over what is left out, would not stay
//! within the budget ([`select`], which has the proof). What is left out counts as the middle of what it could be.
//!
//! - [`render`] is the door: pictures and a [`FrameReport`] of the bound that was kept and of the work that was done.
//!   With [`RenderSettings::budget`] 0 it is the exhaustive path, bit for bit; `render_frame` is `render` without the
//!   report.
//! - A [`Session`] renders one view again and again as codes change: only what an edit changed is evaluated again.
//! - A [`Sequence`] renders many views of one portrait over shared geometry.
//!
//! ```no_run
//! # use cnerf_core::{model::generator::Generator, render::{RenderSettings, plan}};
//! # fn picture(generator: &Generator, codes: &candle_core::Tensor, cameras: &candle_core::Tensor)
//! # -> cnerf_core::Result<()> {
//! let field = generator.field().portraits(codes)?;
//! let settings = RenderSettings { budget: 0.002, ..generator.render_settings() };
//! let planned = plan::render(&field, cameras, &settings)?;
//! assert!(planned.report.bound <= 0.002);
//!
//! let mut session = plan::Session::new(cameras, &settings)?;
//! let first = session.render(&field)?; // all of it
//! let again = session.render(&field)?; // nothing is evaluated again
//!
//! let sequence = plan::Sequence::new(&field, cameras, &settings)?; // cameras of all frames
//! for frame in 0..cameras.dim(0)? {
//!     let planned = sequence.render(&field, &cameras.narrow(0, frame, 1)?)?;
//! }
//! # Ok(()) }
//! ```

use candle_core::{DType, Device, Tensor};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use self::{
    local::Ready,
    march::{Allowance, Marched},
    rays::Rays,
    select::Selection,
    shade::Pixels,
    state::{ChunkState, Room},
};
use crate::{
    error::{Error, Result},
    kernels::{Outputs, Path},
    region::{REGION_COUNT, RegionSet},
    render::{Frame, RadianceField, RayBundle, RenderSettings, frame},
};

mod features;
mod grid;
mod local;
mod march;
mod rays;
mod reach;
mod select;
mod sequence;
mod session;
mod shade;
mod state;
mod whole;

pub use features::LocalFeatures;
pub use local::{LocalField, LocalInitial, LocalWeights};
pub use sequence::Sequence;
pub use session::Session;

/// Rays of a chunk: enough to fill the kernel's tiles for every region, few enough for every core to get some.
const CHUNK_RAYS: usize = 512;
/// Chunks whose results are held at a time.
const CHUNKS_AT_ONCE: usize = 16;
/// The share of a budget that may be spent on ending rays early; light falls so fast that more would gain little.
const CUT_SHARE: f64 = 0.25;
/// The share that may be spent on space that is proven to be almost empty.
const EMPTY_SHARE: f64 = 0.125;
/// Budgets up to here are rendered exhaustively: what rounding may add to a plan's difference from the exhaustive path,
/// in [0, 1] colour units. Both round the same sums in another order: a weight's relative error is that of an optical
/// depth t of S terms, at most S t 2⁻²⁴, and t exp(-t) ≤ 0.37; sigmoids and weighted sums of values in [0, 1] add a few
/// 2⁻²⁴ each.
pub const ROUNDING: f64 = 4e-6;
/// And for each unit of Σ |m_i c_i|: a sum of nine rounded products of rounded masks, under a sigmoid of slope 1/4.
const ROUNDING_PER_LOGIT: f64 = 2.5e-7;

/// How a frame was rendered; the later, the less is certain of its error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Every region at every sample.
    Exhaustive,
    /// By a plan whose bound is proven.
    Planned,
    /// By a plan over shared geometry, whose bound is an estimate.
    Shared,
}

/// What a frame cost and how far it can be from the exhaustive one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameReport {
    /// How it was rendered.
    pub method: Method,
    /// The budget it was given, in [0, 1] colour units.
    pub budget: f64,
    /// The largest difference from the exhaustive path that any colour can have, [0, 1] colour units. Masks and opacity
    /// keep it too, features in units of their activations' range; normals leave out the same pairs but have no bound.
    pub bound: f64,
    /// The pixels' mean of the same.
    pub mean_bound: f64,
    /// Pixels.
    pub rays: usize,
    /// Rays x samples per ray.
    pub samples: usize,
    /// Samples where any shape branch ran for this frame; with [`RenderSettings::two_pass`], those of both passes.
    pub samples_evaluated: usize,
    /// (sample, region) pairs whose shape branch ran for this frame.
    pub shape_pairs_evaluated: usize,
    /// (sample, region) pairs, far plane included, whose texture branch ran for this frame.
    pub pairs_evaluated: usize,
    /// Pairs whose texture branch did not run: left out, or known from an earlier frame.
    pub pairs_skipped: usize,
}

impl FrameReport {
    /// Of frame after frame: counts add up, bounds are the largest, the mean bound is that over all pixels.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        let rays = (self.rays + other.rays).max(1) as f64;
        Self {
            method: self.method.max(other.method),
            budget: self.budget.max(other.budget),
            bound: self.bound.max(other.bound),
            mean_bound: (self.mean_bound * self.rays as f64 + other.mean_bound * other.rays as f64) / rays,
            rays: self.rays + other.rays,
            samples: self.samples + other.samples,
            samples_evaluated: self.samples_evaluated + other.samples_evaluated,
            shape_pairs_evaluated: self.shape_pairs_evaluated + other.shape_pairs_evaluated,
            pairs_evaluated: self.pairs_evaluated + other.pairs_evaluated,
            pairs_skipped: self.pairs_skipped + other.pairs_skipped,
        }
    }

    fn empty(method: Method, budget: f64) -> Self {
        Self {
            method,
            budget,
            bound: 0.0,
            mean_bound: 0.0,
            rays: 0,
            samples: 0,
            samples_evaluated: 0,
            shape_pairs_evaluated: 0,
            pairs_evaluated: 0,
            pairs_skipped: 0,
        }
    }
}

/// A frame and what is known of it.
#[derive(Clone, Debug)]
pub struct Planned {
    /// The pictures.
    pub frame: Frame,
    /// What they cost and how far they can be off.
    pub report: FrameReport,
}

/// What of a field a picture shows.
#[derive(Clone, Copy, Debug)]
struct Shown {
    regions: RegionSet,
    features: bool,
    normals: bool,
}

impl Shown {
    fn new(settings: &RenderSettings) -> Self {
        Self { regions: settings.regions, features: settings.features, normals: settings.normals }
    }

    fn outputs(self) -> Outputs {
        Outputs { gradient: self.normals, colour: true, activations: self.features }
    }
}

/// Pictures of `field` from `cameras` `[B, 6]` (see [`crate::camera::Camera::parameters`]) within
/// [`RenderSettings::budget`] of the exhaustive ones. Budgets of 0 or below what rounding takes are rendered exhaustively:
/// on the kernels ([`whole`]), or, as are fields, devices and settings that no plan covers (not f32 on the CPU,
/// differentiable, two passes), by candle's tensors; both round the same sums in another order.
///
/// # Errors
/// If settings contradict each other, or shapes do not fit.
pub fn render<F: RadianceField>(field: &F, cameras: &Tensor, settings: &RenderSettings) -> Result<Planned> {
    let Some(fields) = fields(field, cameras, settings)? else {
        return by_tensors(field, cameras, settings);
    };
    if is_exhaustive(settings) {
        return exhaustive(field, fields, cameras, settings);
    }
    let view = View::new(cameras, settings)?;
    let shown = Shown::new(settings);
    let mut parts = Parts::default();
    let mut report = FrameReport::empty(Method::Planned, settings.budget);
    for (image, local) in fields.into_iter().enumerate() {
        let ready = Ready::new(local, shown.outputs())?;
        for wave in view.waves() {
            let chunks: Vec<(Rays, Chunk)> = wave
                .par_iter()
                .map(|range| {
                    let rays = view.rays(image, *range)?;
                    let mut state = ChunkState::new(&ready, rays.depths.len());
                    let chunk = Chunk::render(&ready, &rays, shown, settings.budget, &mut state)?;
                    Ok((rays, chunk))
                })
                .collect::<Result<_>>()?;
            for ((rays, chunk), range) in chunks.iter().zip(wave) {
                report = report.and(chunk.report(&ready, rays, settings.budget));
                parts.push(&view, image, *range, &chunk.pixels)?;
            }
        }
    }
    Ok(Planned { frame: parts.frame(&view)?, report })
}

/// Whether nothing may be left out.
fn is_exhaustive(settings: &RenderSettings) -> bool {
    settings.budget <= ROUNDING
}

/// The field of each picture as plain numbers; none if the pictures must be rendered by tensors.
fn fields<F: RadianceField>(field: &F, cameras: &Tensor, settings: &RenderSettings) -> Result<Option<Vec<LocalField>>> {
    settings.validate()?;
    let plain = matches!(cameras.device(), Device::Cpu) && cameras.dtype() == DType::F32 && !Path::is_composed()?;
    if settings.differentiable || settings.two_pass.is_some() || !plain {
        return Ok(None);
    }
    (0..cameras.dim(0)?).map(|image| field.local(image)).collect()
}

/// Every region at every sample, on the kernels.
fn exhaustive<F: RadianceField>(
    field: &F,
    fields: Vec<LocalField>,
    cameras: &Tensor,
    settings: &RenderSettings,
) -> Result<Planned> {
    let view = View::new(cameras, settings)?;
    let shown = Shown::new(settings);
    let mut parts = Parts::default();
    for (image, local) in fields.into_iter().enumerate() {
        let ready = Ready::new(local, shown.outputs())?;
        for wave in view.waves() {
            let chunks: Vec<Pixels> = wave
                .par_iter()
                .map(|range| whole::render(&ready, &view.rays(image, *range)?, &shown))
                .collect::<Result<_>>()?;
            for (pixels, range) in chunks.iter().zip(wave) {
                parts.push(&view, image, *range, pixels)?;
            }
        }
    }
    Ok(Planned { frame: parts.frame(&view)?, report: exhaustive_report(field, cameras, settings)? })
}

/// Every region at every sample, by candle's tensors.
fn by_tensors<F: RadianceField>(field: &F, cameras: &Tensor, settings: &RenderSettings) -> Result<Planned> {
    let (frame, samples_evaluated) = frame::render_exhaustively(field, cameras, settings)?;
    let report = FrameReport { samples_evaluated, ..exhaustive_report(field, cameras, settings)? };
    Ok(Planned { frame, report })
}

fn exhaustive_report<F: RadianceField>(field: &F, cameras: &Tensor, settings: &RenderSettings) -> Result<FrameReport> {
    let (rays, volume) = (cameras.dim(0)? * settings.resolution.pow(2), field.volume_regions());
    let samples = rays * settings.sampling.samples;
    let far = if volume == RegionSet::ALL { 0 } else { rays };
    Ok(FrameReport {
        rays,
        samples,
        samples_evaluated: samples,
        shape_pairs_evaluated: samples * volume.len(),
        pairs_evaluated: samples * volume.len() + far,
        ..FrameReport::empty(Method::Exhaustive, settings.budget)
    })
}

/// The rays of a frame.
struct View {
    bundle: RayBundle,
    depths: Tensor,
    settings: RenderSettings,
    chunks: Vec<(usize, usize)>,
}

impl View {
    fn new(cameras: &Tensor, settings: &RenderSettings) -> Result<Self> {
        let (bundle, depths) = frame::rays(cameras, settings)?;
        let count = settings.resolution * settings.resolution;
        let chunks = (0..count).step_by(CHUNK_RAYS).map(|start| (start, CHUNK_RAYS.min(count - start))).collect();
        Ok(Self { bundle, depths, settings: settings.clone(), chunks })
    }

    /// Chunks of rays (first, count), as many at a time as memory should hold.
    fn waves(&self) -> std::slice::Chunks<'_, (usize, usize)> {
        self.chunks.chunks(CHUNKS_AT_ONCE)
    }

    fn rays(&self, image: usize, range: (usize, usize)) -> Result<Rays> {
        Rays::new(&self.bundle, &self.depths, &self.settings.sampling, image, range)
    }
}

/// One chunk, rendered.
struct Chunk {
    marched: Marched,
    selection: Selection,
    pixels: Pixels,
}

impl Chunk {
    fn render(ready: &Ready, rays: &Rays, shown: Shown, budget: f64, state: &mut ChunkState) -> Result<Self> {
        let mut room = Room::default();
        let allowance = Allowance::of((budget - ROUNDING).max(0.0), rays.samples);
        let marched = march::march(ready, rays, allowance, state, &mut room)?;
        let selection = select::select(ready, rays, &marched, &shown, budget as f32);
        let pixels = shade::shade(ready, rays, &marched, &selection, &shown, state, &mut room)?;
        Ok(Self { marched, selection, pixels })
    }

    fn report(&self, ready: &Ready, rays: &Rays, budget: f64) -> FrameReport {
        let bounds = self.selection.bounds.iter().map(|bound| f64::from(*bound));
        let (samples, regions) = (rays.depths.len(), ready.regions.len());
        let far = if ready.background.is_some() { rays.count() } else { 0 };
        FrameReport {
            method: Method::Planned,
            budget,
            bound: bounds.clone().fold(0.0, f64::max),
            mean_bound: bounds.sum::<f64>() / rays.count().max(1) as f64,
            rays: rays.count(),
            samples,
            samples_evaluated: self.marched.samples_evaluated,
            shape_pairs_evaluated: self.marched.shape_pairs,
            pairs_evaluated: self.pixels.pairs,
            pairs_skipped: samples * regions + far - self.pixels.pairs,
        }
    }
}

/// A frame's tensors, chunk by chunk in the order of its pixels, picture after picture.
#[derive(Default)]
struct Parts {
    colour: Vec<Tensor>,
    features: Vec<Tensor>,
    masks: Vec<Tensor>,
    depth: Vec<Tensor>,
    normal: Vec<Tensor>,
    opacity: Vec<Tensor>,
    point: Vec<Tensor>,
}

impl Parts {
    fn push(&mut self, view: &View, image: usize, (start, count): (usize, usize), pixels: &Pixels) -> Result<()> {
        let rows = |values: &[f32], channels: usize| -> Result<Tensor> {
            Ok(Tensor::from_vec(transposed(values, count, channels), (1, channels, count), &Device::Cpu)?)
        };
        self.colour.push(rows(&pixels.colour, 3)?.affine(2.0, -1.0)?);
        let bundle = view.bundle.narrow(start, count)?;
        let directions = bundle.directions.narrow(0, image, 1)?;
        if view.settings.features {
            self.features.push(rows(&pixels.features, pixels.features.len() / count.max(1))?);
        }
        self.masks.push(rows(&pixels.masks, REGION_COUNT)?);
        self.depth.push(rows(&pixels.depth, 1)?);
        if view.settings.normals {
            self.normal.push(rows(&pixels.normal, 3)?);
        }
        self.opacity.push(rows(&pixels.opacity, 1)?);
        let depth = Tensor::from_slice(&pixels.depth, (1, count, 1), &Device::Cpu)?;
        let point = directions.broadcast_mul(&depth)?.broadcast_add(&bundle.origins.narrow(0, image, 1)?)?;
        self.point.push(point.transpose(1, 2)?.contiguous()?);
        Ok(())
    }

    fn frame(&self, view: &View) -> Result<Frame> {
        let resolution = view.settings.resolution;
        let picture = |parts: &[Tensor]| -> Result<Option<Tensor>> {
            if parts.is_empty() {
                return Ok(None);
            }
            let per_image = parts
                .chunks(view.chunks.len())
                .map(|parts| {
                    let whole = Tensor::cat(parts, 2)?;
                    Ok(whole.reshape((1, whole.dim(1)?, resolution, resolution))?)
                })
                .collect::<Result<Vec<_>>>()?;
            Ok(Some(Tensor::cat(&per_image, 0)?))
        };
        let present = |parts: &[Tensor]| picture(parts)?.ok_or_else(|| Error::config("cameras", "name at least one"));
        Ok(Frame {
            colour: present(&self.colour)?,
            features: picture(&self.features)?,
            masks: present(&self.masks)?,
            depth: present(&self.depth)?,
            normal: picture(&self.normal)?,
            point: present(&self.point)?,
            opacity: present(&self.opacity)?,
        })
    }
}

/// `[rows, columns]` to `[columns, rows]`, block by block, so that both stay in cache.
fn transposed(values: &[f32], rows: usize, columns: usize) -> Vec<f32> {
    const BLOCK: usize = 16;
    let mut result = vec![0.0; values.len()];
    for first_row in (0..rows).step_by(BLOCK) {
        let last_row = rows.min(first_row + BLOCK);
        for first_column in (0..columns).step_by(BLOCK) {
            for column in first_column..columns.min(first_column + BLOCK) {
                for row in first_row..last_row {
                    result[column * rows + row] = values[row * columns + column];
                }
            }
        }
    }
    result
}
