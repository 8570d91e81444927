//! Whole pictures: rays are rendered in chunks, so that memory stays bounded at any resolution.

use candle_core::{DType, Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::{
    camera::{self, pixel_centres},
    error::{Error, Result},
    region::RegionSet,
    render::{
        Outputs, Placement, RadianceField, RayBundle, RayOutput, RayWeights, Sampling, integrate::aggregate, plan,
    },
    rng::Stream,
};

/// What a picture is rendered with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RenderSettings {
    /// Width and height, pixels.
    pub resolution: usize,
    /// Full field of view of a camera at zoom 1, radians.
    pub field_of_view_rad: f64,
    /// The rays' samples.
    pub sampling: Sampling,
    /// Find the surface first and evaluate colours only there. Not differentiable in the geometry.
    pub two_pass: Option<TwoPass>,
    /// Draw samples at random from this seed instead of at regular depths.
    pub perturb: Option<u64>,
    /// Regions that give colour, features and masks. The geometry is always whole.
    pub regions: RegionSet,
    /// Render features too.
    pub features: bool,
    /// Render normals too.
    pub normals: bool,
    /// Keep the graph, to differentiate the picture: memory then grows with rays x samples.
    pub differentiable: bool,
    /// How far colours may be from those of the exhaustive path, in [0, 1] colour units; 0 evaluates every region at
    /// every sample. See [`plan`].
    pub budget: f64,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            resolution: 64,
            field_of_view_rad: camera::FIELD_OF_VIEW_RAD,
            sampling: Sampling::default(),
            two_pass: None,
            perturb: None,
            regions: RegionSet::ALL,
            features: false,
            normals: false,
            differentiable: false,
            budget: 0.0,
        }
    }
}

impl RenderSettings {
    /// Refuses settings that no picture can have.
    pub fn validate(&self) -> Result<()> {
        if self.resolution == 0 {
            return Err(Error::config("resolution", "must be at least 1"));
        }
        if !(self.budget >= 0.0 && self.budget.is_finite()) {
            return Err(Error::config("budget", format!("{} is not a number of at least 0", self.budget)));
        }
        self.sampling.validate()
    }
}

/// Rendering in two passes (recipe): distances at few samples, interpolated to fine bins, tell where the light comes
/// from; colours are evaluated at the middles of equal shares of that light.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TwoPass {
    /// Bins between which distances are interpolated.
    pub bins: usize,
    /// Colour samples per ray, each of the same weight.
    pub colour_samples: usize,
}

impl Default for TwoPass {
    fn default() -> Self {
        Self { bins: 48, colour_samples: 3 }
    }
}

/// Pictures of B portraits, resolution r.
#[derive(Clone, Debug)]
pub struct Frame {
    /// `[B, 3, r, r]` in [-1, 1].
    pub colour: Tensor,
    /// `[B, F, r, r]`, if asked for.
    pub features: Option<Tensor>,
    /// `[B, 9, r, r]`.
    pub masks: Tensor,
    /// Along the view axis, world units, `[B, 1, r, r]`.
    pub depth: Tensor,
    /// Outward, world axes, `[B, 3, r, r]`, if asked for.
    pub normal: Option<Tensor>,
    /// Expected point, world, `[B, 3, r, r]`.
    pub point: Tensor,
    /// Share of light that comes from the volume, `[B, 1, r, r]`.
    pub opacity: Tensor,
}

/// Points evaluated at once for pictures that nobody differentiates: about 200 MB of activations at width 128.
const POINTS_AT_ONCE: usize = 1 << 14;

/// Pictures of `field` from `cameras` `[B, 6]` (see [`camera::Camera::parameters`]); [`plan::render`] without its report.
pub fn render_frame<F: RadianceField>(field: &F, cameras: &Tensor, settings: &RenderSettings) -> Result<Frame> {
    Ok(plan::render(field, cameras, settings)?.frame)
}

/// The rays of all pixels in row order, and the depths of their samples, `[B, R, S]` (or 1 in place of B and R).
pub(super) fn rays(cameras: &Tensor, settings: &RenderSettings) -> Result<(RayBundle, Tensor)> {
    settings.validate()?;
    let (batch, resolution) = (cameras.dim(0)?, settings.resolution);
    let pixels = pixel_centres(resolution, cameras.device())?.to_dtype(cameras.dtype())?;
    let rays = RayBundle::new(camera::cast(cameras, &pixels, resolution, settings.field_of_view_rad)?)?;
    let depths = match settings.perturb {
        Some(seed) => {
            let mut random = Stream::new(seed, &[]);
            let count = resolution * resolution;
            settings.sampling.perturbed(batch, count, &mut random, cameras.dtype(), cameras.device())?
        }
        None => settings.sampling.regular(cameras.dtype(), cameras.device())?,
    };
    Ok((rays, depths))
}

/// Every region at every sample.
pub(super) fn render_exhaustively<F: RadianceField>(
    field: &F,
    cameras: &Tensor,
    settings: &RenderSettings,
) -> Result<Frame> {
    let (batch, resolution) = (cameras.dim(0)?, settings.resolution);
    let (rays, depths) = rays(cameras, settings)?;
    let count = resolution * resolution;
    let chunk = if settings.differentiable {
        count
    } else {
        (POINTS_AT_ONCE / (batch * settings.sampling.samples).max(1)).clamp(1, count)
    };
    let quiet = (!settings.differentiable).then(|| field.detached());
    let field = quiet.as_ref().unwrap_or(field);
    let outputs = Outputs { gradient: settings.normals, colour: true, activations: settings.features };

    let mut columns: [Vec<Tensor>; 7] = Default::default();
    for start in (0..count).step_by(chunk) {
        let length = chunk.min(count - start);
        let rays = rays.narrow(start, length)?;
        let depths = if depths.dim(1)? == 1 { depths.clone() } else { depths.narrow(1, start, length)? };
        let output = match &settings.two_pass {
            Some(two_pass) => {
                render_rays_in_two_passes(field, &rays, &depths, settings, two_pass, outputs, settings.regions)?
            }
            None => render_rays(field, &rays, &depths, &settings.sampling, outputs, settings.regions)?,
        };
        let values = [
            Some(output.colour),
            output.features,
            Some(output.masks),
            Some(output.depth.unsqueeze(1)?),
            output.normal,
            Some(output.point),
            Some(output.weights.remaining.affine(-1.0, 1.0)?.unsqueeze(1)?),
        ];
        for (column, value) in columns.iter_mut().zip(values) {
            column.extend(value.map(|value| if settings.differentiable { value } else { value.detach() }));
        }
    }
    let picture = |parts: &[Tensor]| -> Result<Option<Tensor>> {
        if parts.is_empty() {
            return Ok(None);
        }
        let whole = Tensor::cat(parts, 2)?;
        let channels = whole.dim(1)?;
        Ok(Some(whole.reshape((batch, channels, resolution, resolution))?))
    };
    let present = |parts: &[Tensor]| picture(parts)?.ok_or_else(|| Error::config("resolution", "must be at least 1"));
    let [colour, features, masks, depth, normal, point, opacity] = &columns;
    Ok(Frame {
        colour: present(colour)?,
        features: picture(features)?,
        masks: present(masks)?,
        depth: present(depth)?,
        normal: picture(normal)?,
        point: present(point)?,
        opacity: present(opacity)?,
    })
}

/// Pixels of `rays` with samples at `depths` `[B, R, S]` (or 1 in place of B or R). `outputs` beyond colour cost
/// extra; regions outside `shown` give nothing to the picture. Differentiable in the field and the rays.
pub fn render_rays<F: RadianceField>(
    field: &F,
    rays: &RayBundle,
    depths: &Tensor,
    sampling: &Sampling,
    outputs: Outputs,
    shown: RegionSet,
) -> Result<RayOutput> {
    let (batch, count) = rays.dimensions()?;
    let samples = depths.dim(2)?;
    let view = if field.sees_view() { Some(rays.view_directions_of(samples)?) } else { None };
    let outputs = Outputs { colour: true, ..outputs };
    let evaluation = field.evaluate(&rays.points(depths)?, view.as_ref(), outputs)?;
    let density = field.density(&evaluation.distance)?.reshape((batch, count, samples))?;
    let lengths = sampling.intervals(depths)?.broadcast_mul(&rays.lengths()?.unsqueeze(2)?)?;
    let weights = RayWeights::new(&density, &lengths, sampling.last_interval.is_none())?;
    let background = background(field, rays, outputs)?;
    aggregate(field, rays, depths, weights, evaluation, background.as_ref(), shown)
}

fn background<F: RadianceField>(
    field: &F,
    rays: &RayBundle,
    outputs: Outputs,
) -> Result<Option<crate::render::BackgroundEvaluation>> {
    if field.volume_regions() == RegionSet::ALL {
        return Ok(None);
    }
    let (dtype, device) = (rays.directions.dtype(), rays.directions.device());
    let far = Tensor::full(camera::FAR, (1, 1, 1), device)?.to_dtype(dtype)?;
    field.background(&rays.points(&far)?, Some(&rays.view_directions), outputs.activations)
}

/// Pixels with distances at `depths` and colours at the light's quantiles, see [`TwoPass`].
fn render_rays_in_two_passes<F: RadianceField>(
    field: &F,
    rays: &RayBundle,
    depths: &Tensor,
    settings: &RenderSettings,
    two_pass: &TwoPass,
    outputs: Outputs,
    shown: RegionSet,
) -> Result<RayOutput> {
    if settings.differentiable {
        return Err(Error::config("two_pass", "quantiles have no gradient; render differentiable pictures without it"));
    }
    let (batch, count) = rays.dimensions()?;
    let (samples, dtype, device) = (depths.dim(2)?, depths.dtype(), depths.device());
    let view = if field.sees_view() { Some(rays.view_directions_of(samples)?) } else { None };
    let coarse = field.evaluate(&rays.points(depths)?, view.as_ref(), Outputs::default())?;
    let distance = coarse.distance.reshape((batch, count, samples))?;

    let fine = fine_bins(&settings.sampling, two_pass)?;
    let bins = fine.regular(dtype, device)?;
    let distance = interpolate(&distance, depths, &bins)?;
    let lengths = fine.intervals(&bins)?.broadcast_mul(&rays.lengths()?.unsqueeze(2)?)?;
    let light = RayWeights::new(&field.density(&distance)?, &lengths, fine.last_interval.is_none())?;
    let depths = quantiles(&light.weights, &fine, two_pass.colour_samples)?;

    let view = if field.sees_view() { Some(rays.view_directions_of(two_pass.colour_samples)?) } else { None };
    let evaluation = field.evaluate(&rays.points(&depths)?, view.as_ref(), outputs)?;
    let share = light.remaining.affine(-1.0 / two_pass.colour_samples as f64, 1.0 / two_pass.colour_samples as f64)?;
    let weights = share.unsqueeze(2)?.broadcast_as(depths.shape())?.contiguous()?;
    let weights = RayWeights { weights, remaining: light.remaining };
    let background = background(field, rays, outputs)?;
    aggregate(field, rays, &depths, weights, evaluation, background.as_ref(), shown)
}

/// The bins of two passes over the range of `sampling`.
pub(super) fn fine_bins(sampling: &Sampling, two_pass: &TwoPass) -> Result<Sampling> {
    if two_pass.bins == 0 || two_pass.colour_samples == 0 {
        return Err(Error::config("two_pass", "bins and colour_samples must be at least 1"));
    }
    Ok(Sampling {
        placement: Placement::Stratified,
        samples: two_pass.bins,
        last_interval: sampling.last_interval.map(|_| sampling.interval_of(two_pass.bins)),
        ..*sampling
    })
}

/// `values` `[B, R, S]` at increasing `depths` `[B, R, S]` (or 1s), read at `targets` `[1, 1, T]` by straight lines,
/// constant beyond the ends: `[B, R, T]`.
fn interpolate(values: &Tensor, depths: &Tensor, targets: &Tensor) -> Result<Tensor> {
    let (batch, rays, samples) = values.dims3()?;
    let depths = rows(&depths.broadcast_as(values.shape())?, samples)?;
    let targets: Vec<f64> = targets.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?;
    let mut read = Vec::with_capacity(batch * rays * targets.len());
    for (values, depths) in rows(values, samples)?.iter().zip(&depths) {
        let mut right = 0;
        for target in &targets {
            while right < samples && depths.get(right).is_some_and(|depth| depth < target) {
                right += 1;
            }
            let left = right.saturating_sub(1);
            let end = right.min(samples - 1);
            let (Some(from), Some(to)) = (depths.get(left).zip(values.get(left)), depths.get(end).zip(values.get(end)))
            else {
                return Err(Error::shape("depths", values.len(), &[depths.len()]));
            };
            let span = to.0 - from.0;
            let share = if span > 0.0 { ((target - from.0) / span).clamp(0.0, 1.0) } else { 0.0 };
            read.push(from.1 + share * (to.1 - from.1));
        }
    }
    like(read, (batch, rays, targets.len()), values)
}

/// Depths in the middle of `count` equal shares of the light that `weights` `[B, R, bins]` say comes from each bin.
fn quantiles(weights: &Tensor, bins: &Sampling, count: usize) -> Result<Tensor> {
    let (batch, rays, _) = weights.dims3()?;
    let mut depths = Vec::with_capacity(batch * rays * count);
    for light in rows(weights, bins.samples)? {
        depths.extend(quantiles_of_ray(&light, bins, count));
    }
    like(depths, (batch, rays, count), weights)
}

/// [`quantiles`] of one ray, from the light of each bin.
pub(super) fn quantiles_of_ray(light: &[f64], bins: &Sampling, count: usize) -> impl Iterator<Item = f64> {
    // A trace of light everywhere spreads the samples of rays that meet nothing.
    const TRACE: f64 = 1e-6;
    let total: f64 = light.iter().map(|weight| weight + TRACE).sum();
    let (near, interval) = (bins.near, bins.interval());
    let (mut bin, mut passed) = (0, 0.0);
    (0..count).map(move |share| {
        let wanted = (share as f64 + 0.5) / count as f64 * total;
        let here = |bin: usize| light.get(bin).map_or(0.0, |weight| weight + TRACE);
        while passed + here(bin) < wanted && bin + 1 < light.len() {
            passed += here(bin);
            bin += 1;
        }
        let within = ((wanted - passed) / here(bin).max(1e-9)).clamp(0.0, 1.0);
        near + interval * (bin as f64 + within)
    })
}

fn rows(tensor: &Tensor, length: usize) -> Result<Vec<Vec<f64>>> {
    Ok(tensor.to_dtype(DType::F64)?.contiguous()?.reshape(((), length))?.to_device(&Device::Cpu)?.to_vec2()?)
}

fn like(values: Vec<f64>, shape: (usize, usize, usize), tensor: &Tensor) -> Result<Tensor> {
    Ok(Tensor::from_vec(values, shape, tensor.device())?.to_dtype(tensor.dtype())?)
}
