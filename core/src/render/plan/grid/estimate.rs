//! How far interpolation in a grid may be off, estimated from its vertices.

use rayon::prelude::*;

use super::{Grid, Place};
use crate::{
    config::{Fusion, Residual},
    region::REGION_COUNT,
    render::plan::local::Ready,
};

/// What estimates from the vertices are multiplied by.
const SAFETY: f32 = 2.0;
/// How far a unit of mask that goes from one region to another moves a colour: sigmoid's slope times a difference of
/// logits; of the built-in portraits' near their surface 0.1 at the median, 0.6 at most.
const COLOUR_SLOPE: f32 = 1.0;
/// Largest o exp(-o): a sample's share changes by at most this for each unit of relative change of its optical depth.
const STEEPEST_SHARE: f32 = 0.37;

/// What is estimated of a cell.
#[derive(Clone, Copy, Debug, Default)]
pub struct CellEstimate {
    /// How far interpolated distances may be off, world units.
    pub distance: f32,
    /// How far colours fused with interpolated masks may be off, [0, 1] colour units.
    pub masks: f32,
    /// What interpolating all but the relevant regions may change, [0, 1] colour units.
    pub left_out: f32,
    /// The regions that have to be evaluated where the whole has to, as bits.
    pub relevant: u16,
    /// The least that the signed distance may be anywhere in the cell, world units.
    pub nearest: f32,
}

/// What interpolation next to a vertex may be off by.
#[derive(Clone, Copy, Default)]
struct VertexEstimate {
    /// World units.
    distance: f32,
    /// All regions, [0, 1] colour units.
    colour: f32,
    /// Each region through its share of colour and distance, [0, 1] colour units.
    regions: [f32; REGION_COUNT],
}

impl Grid {
    /// Estimates of the cells; those in cells of a coarser grid that are not near are its.
    pub(super) fn estimate(
        &self,
        field: &Ready,
        negligible: f32,
        coarser: Option<(&Self, &[bool])>,
    ) -> Vec<CellEstimate> {
        let coarse_of = |cell: usize| {
            let (coarse, near) = coarser?;
            let parent = self.parent(self.index(cell));
            if near[parent] { None } else { coarse.estimates.get(parent).copied() }
        };
        let mut wanted = vec![false; self.distances.len()];
        let own: Vec<Option<CellEstimate>> = (0..self.cells.iter().product::<usize>()).map(coarse_of).collect();
        for (cell, _) in own.iter().enumerate().filter(|(_, estimate)| estimate.is_none()) {
            let place = Place { cell, vertex: self.vertex(self.index(cell)), fraction: [0.5; 3] };
            self.corners(place).for_each(|(vertex, _)| wanted[vertex] = true);
        }
        let estimated = |(vertex, wanted)| {
            if wanted { self.estimate_vertex(field, vertex) } else { VertexEstimate::default() }
        };
        let vertices: Vec<VertexEstimate> = wanted.into_par_iter().enumerate().map(estimated).collect();
        let optional = matches!(field.local.fusion, Fusion::Softmax { .. }) && field.local.residual == Residual::Gated;
        own.into_par_iter()
            .enumerate()
            .map(|(cell, estimate)| {
                let place = Place { cell, vertex: self.vertex(self.index(cell)), fraction: [0.5; 3] };
                let estimate = estimate.unwrap_or_else(|| self.estimate_cell(place, &vertices, optional, negligible));
                let nearest = self.furthest(place, |distance, nearest| distance < nearest);
                CellEstimate { nearest: nearest - estimate.distance, ..estimate }
            })
            .collect()
    }

    fn estimate_cell(
        &self,
        place: Place,
        vertices: &[VertexEstimate],
        optional: bool,
        negligible: f32,
    ) -> CellEstimate {
        let regions = self.regions;
        let every = ((1u32 << regions) - 1) as u16;
        let mut estimate = CellEstimate { relevant: every, ..CellEstimate::default() };
        let mut largest = [0f32; REGION_COUNT];
        for (vertex, _) in self.corners(place) {
            let corner = &vertices[vertex];
            estimate.distance = estimate.distance.max(SAFETY * corner.distance);
            estimate.masks = estimate.masks.max(SAFETY * corner.colour).min(1.0);
            for (largest, region) in largest.iter_mut().zip(corner.regions) {
                *largest = largest.max(SAFETY * region);
            }
        }
        let mut order: Vec<usize> = if optional { (0..regions).collect() } else { Vec::new() };
        order.sort_by(|left, right| largest[*left].total_cmp(&largest[*right]));
        for region in order {
            if estimate.left_out + largest[region] > negligible {
                break;
            }
            estimate.left_out += largest[region];
            estimate.relevant &= !(1 << region);
        }
        estimate
    }

    fn estimate_vertex(&self, field: &Ready, vertex: usize) -> VertexEstimate {
        let regions = self.regions;
        let scale = field.local.residual_scale as f32;
        let mut estimate = VertexEstimate {
            distance: self.bend(vertex, |vertex| self.distances[vertex]),
            ..VertexEstimate::default()
        };
        let mut masks = [0f32; REGION_COUNT];
        let raw = &self.raw[vertex * regions * 2..][..regions * 2];
        let fused = field.fuse(raw, &mut masks[..regions]);
        for (region, raw) in raw.chunks_exact(2).enumerate() {
            let bend = |value: usize| self.bend(vertex, |vertex| self.raw[(vertex * regions + region) * 2 + value]);
            let moved_mask = match field.local.fusion {
                Fusion::Raw => bend(0),
                Fusion::Softmax { sharpness } => masks[region] * sharpness as f32 * bend(0),
            };
            let colour = moved_mask * COLOUR_SLOPE;
            let moved = moved_mask * (raw[1] * scale - fused.mean).abs() + masks[region].abs() * scale * bend(1);
            estimate.colour += colour;
            estimate.regions[region] = colour + moved * field.local.inverse_alpha * STEEPEST_SHARE;
        }
        estimate
    }

    /// Σ over the axes of |second difference| / 8: what linear interpolation of a smooth function is off by.
    fn bend(&self, vertex: usize, value: impl Fn(usize) -> f32) -> f32 {
        let counts = self.cells.map(|cells| cells + 1);
        let index = [vertex % counts[0], vertex / counts[0] % counts[1], vertex / (counts[0] * counts[1])];
        let mut sum = 0.0;
        for (axis, stride) in self.strides().into_iter().enumerate() {
            if counts[axis] < 3 {
                continue;
            }
            // At the border, as one vertex further in.
            let middle = match index[axis] {
                0 => vertex + stride,
                last if last + 1 == counts[axis] => vertex - stride,
                _ => vertex,
            };
            sum += (value(middle - stride) - 2.0 * value(middle) + value(middle + stride)).abs() / 8.0;
        }
        sum
    }
}
