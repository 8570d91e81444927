//! Many views of one portrait over shared geometry.

use candle_core::Tensor;
use rayon::prelude::*;

use crate::{
    camera,
    error::Result,
    render::{
        RadianceField, RenderSettings, TwoPass,
        plan::{
            CUT_SHARE, Chunk, FrameReport, Method, Parts, Planned, Shown, View, by_tensors, fields,
            grid::{Grid, Place},
            is_exhaustive,
            local::{LocalField, LocalInitial, Ready, length},
            march::{Light, Marched},
            rays::Rays,
            render, select, shade,
            state::{ChunkState, Room},
        },
        surface,
    },
};

/// The share of a budget that interpolated distances and masks may spend in a pixel.
const INTERPOLATION_SHARE: f64 = 0.25;
/// The share that regions left out of cells may spend.
const REGION_SHARE: f64 = 0.125;
/// The share of [`INTERPOLATION_SHARE`] that light from space taken for empty may spend.
const EMPTY_SHARE: f64 = 0.05;

/// Views of one portrait that share a coarse grid of its geometry.
///
/// The grid tells where along a ray the light comes from. Shape branches run only where interpolated values could be
/// too far off for the budget, and there only for the regions that matter in the cell; everything else is as in
/// [`render`]. The bound it reports is an estimate ([`Method::Shared`]): the grid's errors are estimated from its
/// vertices with a safety factor.
///
/// With [`RenderSettings::two_pass`] samples are placed at the surface instead of at regular depths: light comes from
/// the grid's distances in `bins` bins, and the field is evaluated at its quantiles. That picture approaches the
/// converged integral, not the exhaustive path at the settings' samples.
///
/// Fields whose masks see the view or whose distance starts from a network share nothing; they, and whatever [`render`] renders exhaustively, go that way.
pub struct Sequence {
    settings: RenderSettings,
    shared: Option<Shared>,
}

struct Shared {
    ready: Ready,
    grid: Grid,
}

impl Sequence {
    /// The views from `cameras` `[B, 6]`, all frames of the sequence, of the portrait in `field` (its first).
    ///
    /// # Errors
    /// If settings contradict each other, or shapes do not fit.
    pub fn new<F: RadianceField>(field: &F, cameras: &Tensor, settings: &RenderSettings) -> Result<Self> {
        let plannable = RenderSettings { two_pass: None, ..settings.clone() };
        let first = fields(field, &cameras.narrow(0, 0, 1)?, &plannable)?.and_then(|fields| fields.into_iter().next());
        let shared = match first {
            Some(local) if is_shareable(&local) && !is_exhaustive(settings) => {
                let ready = Ready::new(local, Shown::new(settings).outputs())?;
                let (low, high) = extent(cameras, settings)?;
                let interval = settings.sampling.interval() as f32;
                let empty_from =
                    ready.distance_of(Allowance::of(settings.budget, settings.sampling.samples).empty / interval);
                let grid = Grid::new(&ready, low, high, (settings.budget * REGION_SHARE) as f32, empty_from)?;
                Some(Shared { ready, grid })
            }
            _ => None,
        };
        Ok(Self { settings: settings.clone(), shared })
    }

    /// (point, region) pairs whose shape branches ran for the grid.
    pub fn grid_pairs(&self) -> usize {
        self.shared.as_ref().map_or(0, |shared| shared.grid.pairs())
    }

    /// What the grid keeps in memory, bytes.
    pub fn memory(&self) -> usize {
        self.shared.as_ref().map_or(0, |shared| shared.grid.memory())
    }

    /// Pictures from `cameras` `[B, 6]`, each of the sequence's portrait. `field` is the one the sequence was made of.
    ///
    /// # Errors
    /// As [`render`].
    pub fn render<F: RadianceField>(&self, field: &F, cameras: &Tensor) -> Result<Planned> {
        let Some(shared) = &self.shared else {
            return match self.settings.two_pass {
                Some(_) => by_tensors(field, cameras, &self.settings),
                None => render(field, cameras, &self.settings),
            };
        };
        let view = View::new(cameras, &self.settings)?;
        let shown = Shown::new(&self.settings);
        let mut parts = Parts::default();
        let mut report = FrameReport::empty(Method::Shared, self.settings.budget);
        for image in 0..cameras.dim(0)? {
            for wave in view.waves() {
                let chunks: Vec<(Rays, Chunk)> = wave
                    .par_iter()
                    .map(|range| shared.chunk(view.rays(image, *range)?, shown, &self.settings))
                    .collect::<Result<_>>()?;
                for ((rays, chunk), range) in chunks.iter().zip(wave) {
                    let chunk_report = chunk.report(&shared.ready, rays, self.settings.budget);
                    report = report.and(FrameReport { method: Method::Shared, ..chunk_report });
                    parts.push(&view, image, *range, &chunk.pixels)?;
                }
            }
        }
        Ok(Planned { frame: parts.frame(&view)?, report })
    }
}

/// Whether the geometry is the same from everywhere, and one grid holds all of it.
fn is_shareable(local: &LocalField) -> bool {
    !local.generators.shape.mask_view && !matches!(local.initial, LocalInitial::Network(_))
}

/// The box, world, that holds every sample of these views: the corners of their frustums.
fn extent(cameras: &Tensor, settings: &RenderSettings) -> Result<([f32; 3], [f32; 3])> {
    let corners = Tensor::new(&[[[0f32, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]], cameras.device())?;
    let rays = camera::cast(cameras, &corners, 1, settings.field_of_view_rad)?;
    let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for depth in [settings.sampling.near, settings.sampling.far] {
        let points = (&rays.directions * depth)?.broadcast_add(&rays.origins)?.flatten_to(1)?.to_vec2::<f32>()?;
        for point in points {
            for (axis, value) in point.iter().enumerate().take(3) {
                low[axis] = low[axis].min(*value);
                high[axis] = high[axis].max(*value);
            }
        }
    }
    Ok((low, high))
}

/// What marching a ray over the grid may leave out of its pixel.
struct Allowance {
    /// Light at which a ray ends.
    cut: f32,
    /// What interpolating a sample may change.
    interpolated: f32,
    /// Optical depth that a sample may have and still count as empty.
    empty: f32,
}

impl Allowance {
    fn of(budget: f64, samples: usize) -> Self {
        let interpolated = budget * INTERPOLATION_SHARE / samples.max(1) as f64;
        Self {
            cut: (budget * CUT_SHARE) as f32,
            interpolated: interpolated as f32,
            empty: (interpolated * EMPTY_SHARE) as f32,
        }
    }
}

/// How a sample becomes known.
#[derive(Clone, Copy)]
enum Look {
    /// Not at all: no light comes from there, or none gets there.
    Empty,
    /// From the grid.
    Interpolated(Place),
    /// By the regions that matter there, or by all outside of the grid.
    Exact(Option<Place>),
}

impl Shared {
    fn chunk(&self, rays: Rays, shown: Shown, settings: &RenderSettings) -> Result<(Rays, Chunk)> {
        let mut room = Room::default();
        let budget = settings.budget;
        let (rays, mut state, marched) = match &settings.two_pass {
            Some(two_pass) => self.march_to_the_surface(rays, settings, two_pass, &mut room)?,
            None => {
                let mut state = ChunkState::new(&self.ready, rays.depths.len());
                let marched = self.march(&rays, budget, &mut state, &mut room)?;
                (rays, state, marched)
            }
        };
        let selection = select::select(&self.ready, &rays, &marched, &shown, budget as f32);
        let pixels = shade::shade(&self.ready, &rays, &marched, &selection, &shown, &mut state, &mut room)?;
        Ok((rays, Chunk { marched, selection, pixels }))
    }

    /// Marches rays at their own depths.
    fn march(&self, rays: &Rays, budget: f64, state: &mut ChunkState, room: &mut Room) -> Result<Marched> {
        let samples = rays.samples;
        let allowance = Allowance::of(budget, samples);
        let mut marched = Marched::new(rays, self.ready.regions.len());
        let looks = self.look(rays, &allowance, &mut marched);
        let wanted_at = |look: &Look| match look {
            Look::Exact(place) => Some(place.map_or(u16::MAX, |place| self.grid.estimate_at(place).relevant)),
            _ => None,
        };
        let exact = looks.iter().enumerate().filter_map(|(sample, look)| Some((sample as u32, wanted_at(look)?)));
        let (list, wanted): (Vec<u32>, Vec<u16>) = exact.unzip();
        marched.samples_evaluated = list.len();
        marched.shape_pairs = state.fill_shapes(&self.ready, rays, &list, |place| wanted[place], room)?;
        for ray in 0..rays.count() {
            let mut light = Light::default();
            let reached = marched.marched[ray] as usize;
            for step in 0..reached {
                let sample = ray * samples + step;
                let takes_all = rays.closed && step + 1 == samples;
                match looks[sample] {
                    Look::Empty => continue,
                    Look::Interpolated(place) => {
                        let density = self.ready.density(marched.distances[sample]);
                        let weight = light.pass(density, rays.lengths[sample], takes_all);
                        marched.weights[sample] = weight;
                        if weight <= allowance.empty {
                            marched.unevaluated[ray] += weight;
                        } else {
                            self.interpolate(place, u16::MAX, sample, state);
                            marched.fuse(&self.ready, rays, state, sample);
                        }
                    }
                    Look::Exact(place) => {
                        let mut left_out = 0.0;
                        if let Some(place) = place {
                            let estimate = self.grid.estimate_at(place);
                            self.interpolate(place, !estimate.relevant, sample, state);
                            left_out = estimate.left_out;
                        }
                        marched.fuse(&self.ready, rays, state, sample);
                        let density = self.ready.density(marched.distances[sample]);
                        marched.weights[sample] = light.pass(density, rays.lengths[sample], takes_all);
                        marched.unevaluated[ray] += marched.weights[sample] * left_out;
                    }
                }
                let left = if takes_all { 0.0 } else { light.left() };
                marched.remaining[ray] = left;
                if left <= allowance.cut && step + 1 < reached {
                    marched.marched[ray] = step as u32 + 1;
                    break;
                }
            }
            let end = marched.marched[ray] as usize;
            if end < samples || marched.remaining[ray] <= allowance.cut {
                let left = std::mem::take(&mut marched.remaining[ray]);
                marched.weights[ray * samples + end - 1] += left;
                marched.cut[ray] = left;
            }
        }
        Ok(marched)
    }

    /// How each sample is to become known; sets distances, and how far rays are marched.
    fn look(&self, rays: &Rays, allowance: &Allowance, marched: &mut Marched) -> Vec<Look> {
        let samples = rays.samples;
        let empty_from = self.ready.distance_of(allowance.empty / rays.longest());
        let mut looks = vec![Look::Empty; rays.depths.len()];
        for ray in 0..rays.count() {
            let (mut light, mut brightest) = (Light::default(), Light::default());
            marched.remaining[ray] = 1.0;
            for step in 0..samples {
                let sample = ray * samples + step;
                let takes_all = rays.closed && step + 1 == samples;
                marched.marched[ray] = step as u32 + 1;
                let Some(place) = self.grid.place(rays.point(sample)) else {
                    looks[sample] = Look::Exact(None);
                    continue;
                };
                let estimate = self.grid.estimate_at(place);
                if estimate.nearest >= empty_from && !takes_all {
                    marched.unevaluated[ray] += allowance.empty;
                    continue;
                }
                let distance = self.grid.distance(place);
                marched.distances[sample] = distance;
                // Far from the surface, where nearly all samples are, the rest would compute zeros.
                let dark = self.ready.density(distance - estimate.distance) * rays.lengths[sample];
                if dark <= allowance.empty && !takes_all {
                    looks[sample] = Look::Interpolated(place);
                    marched.unevaluated[ray] += dark;
                    continue;
                }
                let arriving = brightest.left();
                let bright = self.ready.density(distance + estimate.distance);
                let weight = light.pass(self.ready.density(distance), rays.lengths[sample], takes_all);
                brightest.pass(bright, rays.lengths[sample], takes_all);
                let bright = bright * rays.lengths[sample];
                let impact = arriving * ((-bright).exp() - (-dark).exp()) + weight * estimate.masks;
                // Not `impact > allowed`: NaN must be looked at.
                if impact <= allowance.interpolated {
                    looks[sample] = Look::Interpolated(place);
                    marched.unevaluated[ray] += impact;
                } else {
                    looks[sample] = Look::Exact(Some(place));
                }
                if brightest.left() <= allowance.cut {
                    break;
                }
            }
        }
        looks
    }

    /// Puts interpolated raw values of the regions `wanted` (bits) in the place of evaluated ones.
    fn interpolate(&self, place: Place, wanted: u16, sample: usize, state: &mut ChunkState) {
        let values = 2 * self.ready.regions.len();
        self.grid.raw(place, wanted, &mut state.raw[sample * values..][..values]);
    }

    /// Rays whose samples lie where the grid says the light comes from, each with the same share of it.
    fn march_to_the_surface(
        &self,
        mut rays: Rays,
        settings: &RenderSettings,
        two_pass: &TwoPass,
        room: &mut Room,
    ) -> Result<(Rays, ChunkState, Marched)> {
        let fine = two_pass.bins_of(&settings.sampling)?;
        let (bins, samples, regions) = (fine.samples, two_pass.colour_samples, self.ready.regions.len());
        let mut depths = Vec::with_capacity(rays.count() * samples);
        let mut remaining = Vec::with_capacity(rays.count());
        let mut light_of_bins = vec![0f64; bins];
        let allowance = Allowance::of(settings.budget, bins);
        for direction in &rays.directions {
            let unit = length(*direction);
            let empty_from = self.ready.distance_of(allowance.empty / (fine.interval() as f32 * unit));
            let mut light = Light::default();
            for (bin, weight) in light_of_bins.iter_mut().enumerate() {
                let depth = (fine.near + fine.interval() * (bin as f64 + 0.5)) as f32;
                let point = std::array::from_fn(|axis| direction[axis] * depth + rays.origin[axis]);
                let takes_all = rays.closed && bin + 1 == bins;
                let place = self.grid.place(point);
                let is_empty = place.is_none_or(|place| self.grid.estimate_at(place).nearest >= empty_from);
                if is_empty && !takes_all {
                    *weight = 0.0;
                    continue;
                }
                let distance = place.map_or(f32::INFINITY, |place| self.grid.distance(place));
                let passed = light.pass(self.ready.density(distance), fine.interval() as f32 * unit, takes_all);
                *weight = f64::from(passed);
            }
            remaining.push(if rays.closed { 0.0 } else { light.left() });
            depths.extend(surface::quantiles_of_ray(&light_of_bins, &fine, samples).map(|depth| depth as f32));
        }
        rays.samples = samples;
        rays.depths = depths;
        rays.lengths = vec![0.0; rays.depths.len()];
        let mut state = ChunkState::new(&self.ready, rays.depths.len());
        let mut marched = Marched::new(&rays, regions);
        let (mut lit, mut wanted) = (Vec::new(), Vec::new());
        for (ray, remaining) in remaining.into_iter().enumerate() {
            let share = (1.0 - remaining) / samples as f32;
            marched.remaining[ray] = remaining;
            marched.marched[ray] = samples as u32;
            // A pixel without light needs no sample.
            if share * samples as f32 <= (settings.budget * CUT_SHARE) as f32 {
                marched.unevaluated[ray] = share * samples as f32;
                continue;
            }
            for sample in ray * samples..(ray + 1) * samples {
                marched.weights[sample] = share;
                lit.push(sample as u32);
                let place = self.grid.place(rays.point(sample));
                wanted.push(place.map_or(u16::MAX, |place| self.grid.estimate_at(place).relevant));
            }
        }
        marched.samples_evaluated = lit.len();
        marched.shape_pairs = state.fill_shapes(&self.ready, &rays, &lit, |place| wanted[place], room)?;
        for (sample, wanted) in lit.into_iter().zip(wanted) {
            let sample = sample as usize;
            if let Some(place) = self.grid.place(rays.point(sample)) {
                self.interpolate(place, !wanted, sample, &mut state);
            }
            marched.fuse(&self.ready, &rays, &state, sample);
        }
        Ok((rays, state, marched))
    }
}
