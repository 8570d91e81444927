//! One view rendered again and again while codes change: edits re-evaluate only what they changed.

use candle_core::Tensor;
use rayon::prelude::*;

use crate::{
    error::Result,
    render::{
        RadianceField, RenderSettings,
        plan::{
            Chunk, FrameReport, LocalField, LocalInitial, LocalWeights, Method, Parts, Planned, Shown, View, fields,
            is_exhaustive,
            local::Ready,
            render,
            state::{ChunkState, INITIAL_BIT},
        },
    },
};

/// A view, and what is known of the portraits last seen in it.
///
/// What an edit leaves true stays: with a new texture code of a region all shape results and the other regions' heads;
/// with a new shape code the other regions' shape results and heads. What depends on several regions (fused masks,
/// distances, weights, the choice of pairs, sums along rays) is put together anew, so that a frame is bit-identical to
/// the one [`super::render`] gives.
pub struct Session {
    cameras: Tensor,
    view: View,
    /// Per picture.
    known: Vec<Known>,
}

struct Known {
    local: LocalField,
    /// In the order of the view's chunks.
    chunks: Vec<ChunkState>,
}

impl Session {
    /// A session of the view from `cameras` `[B, 6]`.
    ///
    /// # Errors
    /// If settings contradict each other.
    pub fn new(cameras: &Tensor, settings: &RenderSettings) -> Result<Self> {
        Ok(Self { cameras: cameras.clone(), view: View::new(cameras, settings)?, known: Vec::new() })
    }

    /// What is kept in memory, bytes.
    pub fn memory(&self) -> usize {
        self.known.iter().flat_map(|known| &known.chunks).map(ChunkState::memory).sum()
    }

    /// As [`super::render`]; its report counts what was evaluated for this frame. `field` has as many portraits as the
    /// view has cameras; they may be any portraits of any model.
    ///
    /// # Errors
    /// As [`super::render`].
    pub fn render<F: RadianceField>(&mut self, field: &F) -> Result<Planned> {
        let settings = &self.view.settings;
        let Some(fields) = fields(field, &self.cameras, settings)?.filter(|_| !is_exhaustive(settings)) else {
            return render(field, &self.cameras, settings);
        };
        let shown = Shown::new(settings);
        let budget = settings.budget;
        let mut parts = Parts::default();
        let mut report = FrameReport::empty(Method::Planned, budget);
        for (image, local) in fields.into_iter().enumerate() {
            let ready = Ready::new(local, shown.outputs())?;
            if self.known.len() <= image {
                self.known.push(Known { local: ready.local.clone(), chunks: Vec::new() });
            }
            let Some(known) = self.known.get_mut(image) else { continue };
            known.update(&ready);
            known.chunks.resize_with(self.view.chunks.len(), ChunkState::default);
            let view = &self.view;
            for (wave, states) in view.waves().zip(known.chunks.chunks_mut(super::CHUNKS_AT_ONCE)) {
                let chunks: Vec<Result<_>> = wave
                    .par_iter()
                    .zip(states)
                    .map(|(range, state)| {
                        let rays = view.rays(image, *range)?;
                        if state.known.is_empty() {
                            *state = ChunkState::new(&ready, rays.depths.len());
                        }
                        let chunk = Chunk::render(&ready, &rays, shown, budget, state)?;
                        Ok((rays, chunk))
                    })
                    .collect();
                for (result, range) in chunks.into_iter().zip(wave) {
                    let (rays, chunk) = result?;
                    report = report.and(chunk.report(&ready, &rays, budget));
                    parts.push(view, image, *range, &chunk.pixels)?;
                }
            }
        }
        Ok(Planned { frame: parts.frame(&self.view)?, report })
    }
}

impl Known {
    /// Forgets what is no longer true of `ready`'s field.
    fn update(&mut self, ready: &Ready) {
        let (old, new) = (&self.local, &ready.local);
        if old == new {
            return;
        }
        let same_networks = old.volume == new.volume && old.generators.shape == new.generators.shape;
        if !same_networks {
            self.chunks.clear();
        } else {
            for region in 0..ready.regions.len() {
                let (shape, heads) = changes(&old.generators, &new.generators, region);
                for chunk in &mut self.chunks {
                    if shape {
                        chunk.forget_shape(1 << region);
                    }
                    if let Some(store) = chunk.heads.get_mut(region).filter(|_| heads) {
                        store.clear();
                    }
                }
            }
            let network = |field: &LocalField| matches!(field.initial, LocalInitial::Network(_));
            if network(old) != network(new) {
                self.chunks.clear();
            } else if old.initial != new.initial {
                self.chunks.iter_mut().for_each(|chunk| chunk.forget_shape(INITIAL_BIT));
            }
        }
        self.local = new.clone();
    }
}

/// Whether a region's shape branch and whether its heads give other values: the texture layers' numbers (the last
/// two layers, the colour head) do not reach a shape branch that ends on the third.
fn changes(old: &LocalWeights, new: &LocalWeights, region: usize) -> (bool, bool) {
    let ((old_weights, old_film), (new_weights, new_film)) = (old.region(region), new.region(region));
    if old_weights == new_weights && old_film == new_film {
        return (false, false);
    }
    let (depth, width, layout) = (new.shape.residual_depth(), new.shape.width, new.shape.layout());
    let film = depth * 2 * width;
    let layers = layout.layers.get(depth - 1).map_or(0, |layer| layer.bias.end);
    let heads = layout.mask.weight.start..layout.residual.bias.end;
    let shape = old_film[..film] != new_film[..film]
        || old_weights[..layers] != new_weights[..layers]
        || old_weights[heads.clone()] != new_weights[heads];
    (shape, true)
}
