//! From the shape branches to how much of a pixel each sample makes up, front to back: a ray ends where what is left of
//! its light cannot matter.

use crate::{
    error::Result,
    region::REGION_COUNT,
    render::plan::{
        local::Ready,
        rays::Rays,
        state::{ChunkState, Room},
    },
};

/// As in [`crate::render::integrate`]: beyond this optical depth a sample is opaque in every float format.
const OPAQUE: f32 = 100.0;

/// A chunk's light.
pub struct Marched {
    /// Fused masks m_i, `[n S, k]`.
    pub masks: Vec<f32>,
    /// Σ m_i Δd_i, world units, `[n S]`.
    pub means: Vec<f32>,
    /// Signed distances, world units, `[n S]`; 0 behind the last sample marched.
    pub distances: Vec<f32>,
    /// How much of the pixel each sample makes up, `[n S]`; with `remaining` they sum to 1.
    pub weights: Vec<f32>,
    /// Transmittance behind the last sample, `[n]`.
    pub remaining: Vec<f32>,
    /// Samples marched, `[n]`.
    pub marched: Vec<u32>,
    /// Light that was left where the ray was ended early, `[n]`: it counts as the last marched sample's.
    pub cut: Vec<f32>,
    /// What geometry that was not evaluated is estimated to change, [0, 1] colour units, `[n]`.
    pub estimated: Vec<f32>,
    /// (sample, region) pairs whose shape branch ran.
    pub shape_pairs: usize,
    /// Samples where any did.
    pub samples_evaluated: usize,
}

/// A ray's optical depth as it is marched.
#[derive(Clone, Copy, Default)]
pub struct Light {
    through: f32,
}

impl Light {
    /// Transmittance that is left.
    pub fn left(self) -> f32 {
        (-self.through).exp()
    }

    /// Weight of a sample of this density and length; `takes_all` gives it all that is left.
    pub fn pass(&mut self, density: f32, length: f32, takes_all: bool) -> f32 {
        let optical = (density * length).min(OPAQUE);
        let arriving = self.left();
        self.through += optical;
        // NaN densities must show, so no clamping beyond the bound that tensors have too.
        if takes_all { arriving } else { arriving * -(-optical).exp_m1() }
    }
}

/// Marches rays, ending each where its transmittance falls to `cut` or below; 0 never ends one.
pub fn march(field: &Ready, rays: &Rays, cut: f32, state: &mut ChunkState, room: &mut Room) -> Result<Marched> {
    let (count, samples, regions) = (rays.count(), rays.samples, field.regions.len());
    let mut marched = Marched::new(rays, regions);
    let every = ((1u32 << regions) - 1) as u16;
    let mut light = vec![Light::default(); count];
    let mut active: Vec<u32> = (0..count as u32).collect();
    let mut at: Vec<u32> = Vec::with_capacity(count);
    for step in 0..samples {
        at.clear();
        at.extend(active.iter().map(|ray| ray * samples as u32 + step as u32));
        marched.samples_evaluated += at.iter().filter(|sample| !state.known[**sample as usize] & every != 0).count();
        marched.shape_pairs += state.fill_shapes(field, rays, &at, |_| every, room)?;
        active.retain(|ray| {
            let ray = *ray as usize;
            let sample = ray * samples + step;
            marched.fuse(field, rays, state, sample);
            let density = field.density(marched.distances[sample]);
            let takes_all = rays.closed && step + 1 == samples;
            marched.weights[sample] = light[ray].pass(density, rays.lengths[sample], takes_all);
            marched.marched[ray] = step as u32 + 1;
            let left = if takes_all { 0.0 } else { light[ray].left() };
            marched.remaining[ray] = left;
            if left <= cut && cut > 0.0 && step + 1 < samples {
                marched.weights[sample] += left;
                (marched.cut[ray], marched.remaining[ray]) = (left, 0.0);
                return false;
            }
            true
        });
        if active.is_empty() {
            break;
        }
    }
    Ok(marched)
}

impl Marched {
    /// Nothing marched yet.
    pub fn new(rays: &Rays, regions: usize) -> Self {
        let (count, samples) = (rays.count(), rays.depths.len());
        Self {
            masks: vec![0.0; samples * regions],
            means: vec![0.0; samples],
            distances: vec![0.0; samples],
            weights: vec![0.0; samples],
            remaining: vec![0.0; count],
            marched: vec![0; count],
            cut: vec![0.0; count],
            estimated: vec![0.0; count],
            shape_pairs: 0,
            samples_evaluated: 0,
        }
    }

    /// What a ray's marching spent of its pixel's budget.
    pub fn spent(&self, ray: usize) -> f32 {
        self.cut[ray] + self.estimated[ray]
    }

    /// Masks, mean and distance of a sample whose raw values are known.
    pub fn fuse(&mut self, field: &Ready, rays: &Rays, state: &ChunkState, sample: usize) {
        let regions = field.regions.len();
        let mut masks = [0.0; REGION_COUNT];
        let fused = field.fuse(&state.raw[sample * regions * 2..][..regions * 2], &mut masks[..regions]);
        self.masks[sample * regions..][..regions].copy_from_slice(&masks[..regions]);
        self.means[sample] = fused.mean;
        let network = state.initial.get(sample).copied().unwrap_or(0.0);
        self.distances[sample] = field.distance(rays.point(sample), fused.residual, network);
    }
}
