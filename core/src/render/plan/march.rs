//! From the shape branches to how much of a pixel each sample makes up, front to back: a ray ends where what is left of
//! its light cannot matter, and space that is proven empty is passed by.

use crate::{
    error::Result,
    region::REGION_COUNT,
    render::plan::{
        CUT_SHARE, EMPTY_SHARE,
        local::Ready,
        rays::Rays,
        reach::{PartlyKnown, Reach},
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
    /// What geometry that was not evaluated may change, [0, 1] colour units, `[n]`: proven in plans, estimated over shared
    /// geometry.
    pub unevaluated: Vec<f32>,
    /// (sample, region) pairs whose shape branch ran.
    pub shape_pairs: usize,
    /// Samples where any did.
    pub samples_evaluated: usize,
}

/// A ray's light as it is marched.
#[derive(Clone, Copy)]
pub struct Light {
    /// Optical depth so far.
    through: f32,
    left: f32,
}

impl Default for Light {
    /// All of it.
    fn default() -> Self {
        Self { through: 0.0, left: 1.0 }
    }
}

impl Light {
    /// Transmittance that is left.
    pub fn left(self) -> f32 {
        self.left
    }

    /// Weight of a sample of this density and length; `takes_all` gives it all that is left.
    pub fn pass(&mut self, density: f32, length: f32, takes_all: bool) -> f32 {
        let optical = (density * length).min(OPAQUE);
        let arriving = self.left;
        self.through += optical;
        self.left = (-self.through).exp();
        // NaN densities must show, so no clamping beyond the bound that tensors have too.
        if takes_all { arriving } else { arriving * -(-optical).exp_m1() }
    }
}

/// What marching may leave out of a pixel.
#[derive(Clone, Copy)]
pub struct Allowance {
    /// Light at which a ray ends.
    cut: f32,
    /// Optical depth that a sample may have and still count as empty.
    empty: f32,
}

impl Allowance {
    /// No ray ends early, every sample counts.
    pub const NOTHING: Self = Self { cut: 0.0, empty: 0.0 };

    /// The shares of `budget` that are marching's, for rays of `samples` samples.
    pub fn of(budget: f64, samples: usize) -> Self {
        let empty = budget * EMPTY_SHARE / samples.max(1) as f64;
        Self { cut: (budget * CUT_SHARE) as f32, empty: empty as f32 }
    }
}

/// Marches rays, ending each where its transmittance falls to what is allowed or below.
///
/// A sample counts as empty if its optical depth τ is proven small ([`Reach`]): with T the light that arrives there,
/// leaving it out moves the pixel from (1 - e^-τ) T c + e^-τ T c' to T c', where c and c', its own colour and what
/// lies behind, are in [0, 1]: by no more than T τ.
pub fn march(
    field: &Ready,
    rays: &Rays,
    allowance: Allowance,
    state: &mut ChunkState,
    room: &mut Room,
) -> Result<Marched> {
    let (count, samples, regions) = (rays.count(), rays.samples, field.regions.len());
    let mut marched = Marched::new(rays, regions);
    let every = ((1u32 << regions) - 1) as u16;
    let reach = field.reach.as_ref().filter(|_| allowance.empty > 0.0);
    let empty_from = field.distance_of(allowance.empty / rays.longest());
    let cut = allowance.cut;
    let mut light = vec![Light::default(); count];
    let mut active: Vec<u32> = (0..count as u32).collect();
    let mut at: Vec<u32> = Vec::with_capacity(count);
    // Proven distances of the step's empty samples; others are evaluated.
    let mut empty: Vec<Option<f32>> = vec![None; count];
    for step in 0..samples {
        at.clear();
        at.extend(active.iter().map(|ray| ray * samples as u32 + step as u32));
        let takes_all = rays.closed && step + 1 == samples;
        marched.samples_evaluated += match reach.filter(|_| !takes_all) {
            Some(reach) => {
                let mut proof = Proof { reach, empty_from, empty: &mut empty, open: Vec::new() };
                proof.run(field, rays, &at, state, &mut marched, room)?
            }
            None => {
                let unknown = at.iter().filter(|sample| !state.known[**sample as usize] & every != 0).count();
                marched.shape_pairs += state.fill_shapes(field, rays, &at, |_| every, room)?;
                unknown
            }
        };
        active.retain(|ray| {
            let ray = *ray as usize;
            let sample = ray * samples + step;
            marched.marched[ray] = step as u32 + 1;
            if let Some(distance) = empty[ray].take() {
                let optical = field.density(distance) * rays.lengths[sample];
                marched.distances[sample] = distance;
                marched.unevaluated[ray] += light[ray].left() * optical;
                marched.remaining[ray] = light[ray].left();
                return true;
            }
            marched.fuse(field, rays, state, sample);
            let density = field.density(marched.distances[sample]);
            marched.weights[sample] = light[ray].pass(density, rays.lengths[sample], takes_all);
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

/// Shape branches of one step, region after region, until each sample's are known or it is proven empty.
struct Proof<'a> {
    reach: &'a Reach,
    /// Signed distance from which on a sample counts as empty, world units.
    empty_from: f32,
    /// Per ray.
    empty: &'a mut [Option<f32>],
    /// Samples of which nothing is proven yet.
    open: Vec<(u32, PartlyKnown)>,
}

impl Proof<'_> {
    /// Returns the number of samples where any shape branch ran.
    fn run(
        &mut self,
        field: &Ready,
        rays: &Rays,
        samples: &[u32],
        state: &mut ChunkState,
        marched: &mut Marched,
        room: &mut Room,
    ) -> Result<usize> {
        let regions = field.regions.len();
        self.open.extend(samples.iter().map(|sample| (*sample, self.reach.start(rays.point(*sample as usize)))));
        let before: Vec<u16> = samples.iter().map(|sample| state.known[*sample as usize]).collect();
        let mut wanted = Vec::with_capacity(samples.len());
        for (place, region) in self.reach.order.iter().enumerate() {
            let (reach, empty_from, empty) = (self.reach, self.empty_from, &mut *self.empty);
            wanted.clear();
            self.open.retain(|(sample, known)| {
                let least = reach.least_distance(known, place);
                let is_empty = least >= empty_from;
                if is_empty {
                    empty[*sample as usize / rays.samples] = Some(least);
                } else {
                    wanted.push(*sample);
                }
                !is_empty
            });
            marched.shape_pairs += state.fill_shape(field, rays, &wanted, *region, room)?;
            for (sample, known) in &mut self.open {
                let raw = &state.raw[(*sample as usize * regions + region) * 2..][..2];
                self.reach.learn(known, raw);
            }
        }
        Ok(samples.iter().zip(before).filter(|(sample, before)| state.known[**sample as usize] != *before).count())
    }
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
            unevaluated: vec![0.0; count],
            shape_pairs: 0,
            samples_evaluated: 0,
        }
    }

    /// What a ray's marching spent of its pixel's budget.
    pub fn spent(&self, ray: usize) -> f32 {
        self.cut[ray] + self.unevaluated[ray]
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
