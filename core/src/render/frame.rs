//! Whole pictures: rays are rendered in chunks, so that memory stays bounded at any resolution.

use candle_core::Tensor;
use serde::{Deserialize, Serialize};

use crate::{
    camera::{self, pixel_centres},
    error::{Error, Result},
    region::RegionSet,
    render::{
        Outputs, RadianceField, RayBundle, RayOutput, RayWeights, Sampling, TwoPass, integrate::aggregate, plan,
        surface,
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
    /// Find the surface first and evaluate colours only there, see [`surface`]. Not differentiable in the geometry; its
    /// first samples are at regular depths whatever `perturb`.
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

impl Frame {
    /// The same part of every picture.
    pub fn try_map(&self, part: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        Ok(Self {
            colour: part(&self.colour)?,
            features: self.features.as_ref().map(&part).transpose()?,
            masks: part(&self.masks)?,
            depth: part(&self.depth)?,
            normal: self.normal.as_ref().map(&part).transpose()?,
            point: part(&self.point)?,
            opacity: part(&self.opacity)?,
        })
    }
}

/// Points evaluated at once for pictures that nobody differentiates: about 200 MB of activations at width 128.
const POINTS_AT_ONCE: usize = 1 << 14;
/// Points evaluated at once for pictures that are differentiated: the graph grows with all of them, but the gradients
/// of the activations, several times their size, live for one chunk at a time, in memory that the next one uses again.
const DIFFERENTIABLE_POINTS_AT_ONCE: usize = 1 << 13;

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

/// Every region at every sample; and the number of samples.
pub(super) fn render_exhaustively<F: RadianceField>(
    field: &F,
    cameras: &Tensor,
    settings: &RenderSettings,
) -> Result<(Frame, usize)> {
    if settings.differentiable && settings.two_pass.is_some() {
        return Err(Error::config("two_pass", "quantiles have no gradient; render differentiable pictures without it"));
    }
    let (batch, resolution) = (cameras.dim(0)?, settings.resolution);
    let (rays, depths) = rays(cameras, settings)?;
    let count = resolution * resolution;
    let at_once = if settings.differentiable { DIFFERENTIABLE_POINTS_AT_ONCE } else { POINTS_AT_ONCE };
    let chunk = (at_once / (batch * settings.sampling.samples).max(1)).clamp(1, count);
    let quiet = (!settings.differentiable).then(|| field.detached());
    let field = quiet.as_ref().unwrap_or(field);
    let outputs = Outputs { gradient: settings.normals, colour: true, activations: settings.features };

    // Samples at the surface choose their places themselves, from the same first depths for all rays.
    let first = match settings.two_pass {
        Some(_) => {
            let depths = settings.sampling.regular(cameras.dtype(), cameras.device())?;
            Some(surface::FirstSamples::new(field, &rays, &depths, resolution)?)
        }
        None => None,
    };
    let mut samples = first.as_ref().map_or(0, |first| first.taken);
    let mut columns: [Vec<Tensor>; 7] = Default::default();
    for start in (0..count).step_by(chunk) {
        let length = chunk.min(count - start);
        let rays = rays.narrow(start, length)?;
        let depths = if depths.dim(1)? == 1 { depths.clone() } else { depths.narrow(1, start, length)? };
        let output = match settings.two_pass.as_ref().zip(first.as_ref()) {
            Some((two_pass, first)) => {
                let (output, taken) = surface::render_rays(
                    field,
                    &rays,
                    (first, start),
                    (&settings.sampling, two_pass),
                    outputs,
                    settings.regions,
                )?;
                samples += taken;
                output
            }
            None => {
                samples += batch * length * settings.sampling.samples;
                render_rays(field, &rays, &depths, &settings.sampling, outputs, settings.regions)?
            }
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
    let frame = Frame {
        colour: present(colour)?,
        features: picture(features)?,
        masks: present(masks)?,
        depth: present(depth)?,
        normal: picture(normal)?,
        point: present(point)?,
        opacity: present(opacity)?,
    };
    Ok((frame, samples))
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

pub(super) fn background<F: RadianceField>(
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
