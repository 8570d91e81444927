//! Every region at every sample: the exhaustive path on the kernels.
//!
//! Rays are rendered in parts so small that everything the generators give of a part, activations included, stays in
//! the last cache until it is fused over regions and summed along its rays: what leaves is per ray, not per point. The sums are
//! those of a plan that leaves nothing out. How rays are parted depends on sizes alone.

use crate::{
    error::Result,
    render::plan::{
        Shown,
        local::Ready,
        march::{self, Allowance},
        rays::Rays,
        select::Selection,
        shade::{self, Pixels},
        state::{ChunkState, Room},
    },
};

/// Samples of a part: full tiles for the kernel, enough of them to repay fetching every region's weights; at the authors'
/// sizes, 7 MB of activations.
const PART_SAMPLES: usize = 1536;

/// The pixels of `rays`, nothing left out.
pub fn render(field: &Ready, rays: &Rays, shown: &Shown) -> Result<Pixels> {
    let rays_at_once = (PART_SAMPLES / rays.samples.max(1)).max(1);
    let (mut room, mut state) = (Room::default(), ChunkState::default());
    let mut pixels = Pixels::default();
    for start in (0..rays.count()).step_by(rays_at_once) {
        let part = rays.part(start..rays.count().min(start + rays_at_once));
        if state.known.len() == part.depths.len() {
            state.forget();
        } else {
            state = ChunkState::new(field, part.depths.len());
        }
        let samples: Vec<u32> = (0..part.depths.len() as u32).collect();
        state.fill_heads(field, &part, &samples, &mut room)?;
        let marched = march::march(field, &part, Allowance::NOTHING, &mut state, &mut room)?;
        let everything = Selection::of_everything(field, &part, shown, samples);
        pixels.append(shade::shade(field, &part, &marched, &everything, shown, &mut state, &mut room)?);
    }
    Ok(pixels)
}
