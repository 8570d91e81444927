//! A coarse grid of one portrait's distance and masks over the volume, shared by all frames of a sequence.
//!
//! Between vertices values are interpolated; how far they may be off, and which regions matter in a cell, is ESTIMATED
//! from the vertices with a safety factor, not proven: intervals pushed through three sine layers whose angles change by
//! several radians across a cell cover [-1, 1], so proven bounds say nothing at cells that are affordable (see the
//! test `proven_bounds_of_a_cell_say_nothing_at_affordable_sizes`).
//!
//! There are two levels, each made this way: the fine one is evaluated around the surface alone, where the coarse one
//! sees neither empty space nor the inside.

mod estimate;

use rayon::prelude::*;

use self::estimate::CellEstimate;
use crate::{
    error::Result,
    region::REGION_COUNT,
    render::plan::local::{Ready, scaled},
};

/// Coarse cells along the longest side. A head of 0.06 units' radius is then some ten cells across.
const COARSE_CELLS: usize = 28;
/// Fine cells along a coarse one.
const FINENESS: usize = 2;
/// Depth below the surface, in units of α, behind which no light is left to see anything by.
const DEEP: f32 = 8.0;
/// Vertices evaluated at once.
const VERTICES_AT_ONCE: usize = 4096;

/// The grid.
pub struct Grid {
    low: [f32; 3],
    cell: f32,
    cells: [usize; 3],
    regions: usize,
    /// Signed distances at the vertices, world units.
    distances: Vec<f32>,
    /// Raw masks and residuals at the vertices, `[V, k, 2]`.
    raw: Vec<f32>,
    /// Per cell.
    estimates: Vec<CellEstimate>,
    /// Vertices, of both levels, at which the field was evaluated; the others are interpolated.
    evaluated: usize,
}

/// Where a point lies in the grid.
#[derive(Clone, Copy)]
pub struct Place {
    cell: usize,
    vertex: usize,
    fraction: [f32; 3],
}

/// Values at some vertices.
#[derive(Default)]
struct Vertices {
    distances: Vec<f32>,
    raw: Vec<f32>,
}

impl Grid {
    /// The grid of `field`, which has no initial network and no masks that see the view, over the box `low .. high`,
    /// world. In each cell regions may be interpolated whose effects sum to at most `negligible`, [0, 1] colour units;
    /// what is as far from the surface as `empty_from`, world units, nobody will look at closely.
    pub fn new(field: &Ready, low: [f32; 3], high: [f32; 3], negligible: f32, empty_from: f32) -> Result<Self> {
        let extent: [f32; 3] = std::array::from_fn(|axis| (high[axis] - low[axis]).max(1e-6));
        let cell = extent.iter().fold(0f32, |longest, side| longest.max(*side)) / COARSE_CELLS as f32;
        let cells = extent.map(|side| ((side / cell).ceil() as usize).clamp(1, COARSE_CELLS));
        let mut coarse = Self::empty(field, low, cell, cells);
        coarse.fill(field, None)?;
        coarse.estimates = coarse.estimate(field, negligible, None);

        let mut fine = Self::empty(field, low, cell / FINENESS as f32, cells.map(|cells| cells * FINENESS));
        let near = coarse.near(field, empty_from);
        fine.fill(field, Some((&coarse, &near)))?;
        fine.estimates = fine.estimate(field, negligible, Some((&coarse, &near)));
        fine.evaluated += coarse.evaluated;
        Ok(fine)
    }

    fn empty(field: &Ready, low: [f32; 3], cell: f32, cells: [usize; 3]) -> Self {
        let regions = field.regions.len();
        let vertices = cells.iter().map(|cells| cells + 1).product::<usize>();
        Self {
            low,
            cell,
            cells,
            regions,
            distances: vec![0.0; vertices],
            raw: vec![0.0; vertices * regions * 2],
            estimates: Vec::new(),
            evaluated: 0,
        }
    }

    /// Shape branches that were run for it: one a vertex and region.
    pub fn pairs(&self) -> usize {
        self.evaluated * self.regions
    }

    /// Values kept.
    pub fn memory(&self) -> usize {
        size_of::<f32>() * (self.distances.len() + self.raw.len()) + size_of_val(&self.estimates[..])
    }

    /// Where a world point lies; none outside of the grid.
    pub fn place(&self, point: [f32; 3]) -> Option<Place> {
        let mut fraction = [0.0; 3];
        let mut index = [0; 3];
        for axis in 0..3 {
            let position = (point[axis] - self.low[axis]) / self.cell;
            let cells = self.cells[axis] as f32;
            // Rounding may put the outermost samples just outside.
            if !(-1e-3..=cells + 1e-3).contains(&position) {
                return None;
            }
            index[axis] = (position.max(0.0) as usize).min(self.cells[axis] - 1);
            fraction[axis] = position - index[axis] as f32;
        }
        let cell = (index[2] * self.cells[1] + index[1]) * self.cells[0] + index[0];
        Some(Place { cell, vertex: self.vertex(index), fraction })
    }

    /// The signed distance, interpolated, world units.
    pub fn distance(&self, place: Place) -> f32 {
        self.corners(place).map(|(vertex, share)| share * self.distances[vertex]).sum()
    }

    /// Writes the raw values of the regions `wanted` (bits), interpolated, among `raw` `[k, 2]`.
    pub fn raw(&self, place: Place, wanted: u16, raw: &mut [f32]) {
        let mut sums = [0f32; 2 * REGION_COUNT];
        let sums = &mut sums[..2 * self.regions];
        for (vertex, share) in self.corners(place) {
            for (sum, value) in sums.iter_mut().zip(&self.raw[vertex * 2 * self.regions..]) {
                *sum += share * value;
            }
        }
        for (region, (values, sums)) in raw.chunks_exact_mut(2).zip(sums.chunks_exact(2)).enumerate() {
            if wanted & 1 << region != 0 {
                values.copy_from_slice(sums);
            }
        }
    }

    pub fn estimate_at(&self, place: Place) -> &CellEstimate {
        &self.estimates[place.cell]
    }

    /// The most extreme signed distance at a cell's corners; NaN if any is.
    fn furthest(&self, place: Place, is_further: impl Fn(f32, f32) -> bool) -> f32 {
        let distances = self.corners(place).map(|(vertex, _)| self.distances[vertex]);
        let further = |kept: f32, own: f32| if own.is_nan() || is_further(own, kept) { own } else { kept };
        distances.reduce(further).unwrap_or(f32::NAN)
    }

    fn vertex(&self, index: [usize; 3]) -> usize {
        (index[2] * (self.cells[1] + 1) + index[1]) * (self.cells[0] + 1) + index[0]
    }

    /// Steps from a vertex to the next along each axis.
    fn strides(&self) -> [usize; 3] {
        let row = self.cells[0] + 1;
        [1, row, row * (self.cells[1] + 1)]
    }

    /// The cell's vertices and their shares of its interpolation.
    fn corners(&self, place: Place) -> impl Iterator<Item = (usize, f32)> {
        let strides = self.strides();
        (0..8).map(move |corner: usize| {
            let (mut vertex, mut share) = (place.vertex, 1.0);
            for (axis, stride) in strides.into_iter().enumerate() {
                if corner >> axis & 1 == 1 {
                    vertex += stride;
                    share *= place.fraction[axis];
                } else {
                    share *= 1.0 - place.fraction[axis];
                }
            }
            (vertex, share)
        })
    }

    /// Per cell, whether light may end in it.
    fn near(&self, field: &Ready, empty_from: f32) -> Vec<bool> {
        let deep = -DEEP / field.local.inverse_alpha;
        let is_near = |cell: usize| {
            let (index, estimate) = (self.index(cell), &self.estimates[cell]);
            let place = Place { cell, vertex: self.vertex(index), fraction: [0.5; 3] };
            let deepest = self.furthest(place, |distance, deepest| distance > deepest);
            // Not the other way round: NaN must be looked at.
            let is_far = estimate.nearest >= empty_from || deepest + estimate.distance <= deep;
            !is_far
        };
        (0..self.estimates.len()).map(is_near).collect()
    }

    /// The cell's place along each axis.
    fn index(&self, cell: usize) -> [usize; 3] {
        let [columns, rows, _] = self.cells;
        [cell % columns, cell / columns % rows, cell / (columns * rows)]
    }

    /// The cell of a grid [`FINENESS`] times coarser that holds the cell at `index`.
    fn parent(&self, index: [usize; 3]) -> usize {
        let [columns, rows, _] = self.cells.map(|cells| cells / FINENESS);
        let [column, row, layer] = index.map(|index| index / FINENESS);
        (layer * rows + row) * columns + column
    }

    /// The world point of a vertex.
    fn position(&self, vertex: usize) -> [f32; 3] {
        let [columns, rows, _] = self.cells.map(|cells| cells + 1);
        let index = [vertex % columns, vertex / columns % rows, vertex / (columns * rows)];
        std::array::from_fn(|axis| self.low[axis] + self.cell * index[axis] as f32)
    }

    /// Values at the vertices: evaluated everywhere, or where cells of a coarser grid are near, and else interpolated
    /// in that.
    fn fill(&mut self, field: &Ready, coarser: Option<(&Self, &[bool])>) -> Result<()> {
        let total = self.distances.len();
        let mut wanted = vec![coarser.is_none(); total];
        if let Some((coarse, near)) = coarser {
            for (cell, _) in near.iter().enumerate().filter(|(_, near)| **near) {
                let [column, row, layer] = coarse.index(cell).map(|index| index * FINENESS);
                for up in 0..=FINENESS {
                    for along in 0..=FINENESS {
                        let first = self.vertex([column, row + along, layer + up]);
                        wanted[first..=first + FINENESS].fill(true);
                    }
                }
            }
        }
        let regions = self.regions;
        let evaluated: Vec<usize> = (0..total).filter(|vertex| wanted[*vertex]).collect();
        self.evaluated = evaluated.len();
        let blocks: Vec<Vertices> = evaluated
            .par_chunks(VERTICES_AT_ONCE)
            .map(|vertices| self.evaluate(field, vertices))
            .collect::<Result<_>>()?;
        for (vertices, block) in evaluated.chunks(VERTICES_AT_ONCE).zip(blocks) {
            let values = block.distances.iter().zip(block.raw.chunks_exact(regions * 2));
            for (vertex, (distance, raw)) in vertices.iter().zip(values) {
                self.distances[*vertex] = *distance;
                self.raw[vertex * regions * 2..][..regions * 2].copy_from_slice(raw);
            }
        }
        if let Some((coarse, _)) = coarser {
            let positions: Vec<[f32; 3]> = (0..total).map(|vertex| self.position(vertex)).collect();
            let values = self.distances.par_iter_mut().zip(self.raw.par_chunks_exact_mut(regions * 2));
            values.zip(positions).zip(wanted).filter(|(_, wanted)| !wanted).for_each(
                |(((distance, raw), point), _)| {
                    if let Some(place) = coarse.place(point) {
                        *distance = coarse.distance(place);
                        coarse.raw(place, u16::MAX, raw);
                    }
                },
            );
        }
        Ok(())
    }

    fn evaluate(&self, field: &Ready, vertices: &[usize]) -> Result<Vertices> {
        let (columns, regions) = (field.columns(), self.regions);
        let points: Vec<[f32; 3]> = vertices.iter().map(|vertex| self.position(*vertex)).collect();
        let mut inputs = Vec::with_capacity(points.len() * columns);
        for point in &points {
            inputs.extend(point.map(scaled));
            inputs.extend(std::iter::repeat_n(0.0, columns - 3));
        }
        let mut raw = vec![0.0; points.len() * regions * 2];
        let mut values = vec![0.0; points.len() * 2];
        for (region, shape) in field.shape.iter().enumerate() {
            shape.forward(&inputs, &mut values)?;
            for (point, values) in values.chunks_exact(2).enumerate() {
                raw[(point * regions + region) * 2..][..2].copy_from_slice(values);
            }
        }
        let mut distances = Vec::with_capacity(points.len());
        let mut masks = [0f32; REGION_COUNT];
        for (point, raw) in points.iter().zip(raw.chunks_exact(regions * 2)) {
            let fused = field.fuse(raw, &mut masks[..regions]);
            distances.push(field.distance(*point, fused.residual, 0.0));
        }
        Ok(Vertices { distances, raw })
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use candle_core::Device;

    use super::*;
    use crate::{
        config::Fusion,
        kernels::SHAPE_LAYERS,
        model::generator::Generator,
        render::{RadianceField as _, plan::LocalField},
    };

    fn built_in_portrait() -> LocalField {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../models/portrait.safetensors");
        let generator = Generator::open(Path::new(path), &Device::Cpu).unwrap();
        let codes = generator.codes_from_seed(3, 0.7).unwrap();
        generator.field().portraits(&codes).unwrap().local(0).unwrap().unwrap()
    }

    /// Proven radii of a region's raw mask and residual over the box centre ± half (network units): an affine
    /// form in the three coordinates is carried through the layers, sin(m + t) = sin m + t cos m ± t²/2 where that is
    /// tighter than ± 1.
    fn proven_radii(field: &LocalField, region: usize, centre: [f64; 3], half: f64) -> [f64; 2] {
        let layout = field.generators.shape.layout();
        let width = field.generators.shape.width;
        let (weights, film) = field.generators.region(region);
        let mut values: Vec<f64> = centre.to_vec();
        let mut slopes: Vec<[f64; 3]> =
            (0..3).map(|axis| std::array::from_fn(|other| f64::from(u8::from(other == axis)) * half)).collect();
        let mut errors = vec![0f64; 3];
        let affine = |row: &[f32], gamma: f64, offset: f64, values: &[f64], slopes: &[[f64; 3]], errors: &[f64]| {
            let (mut value, mut slope, mut error) = (offset, [0f64; 3], 0f64);
            for (input, weight) in row.iter().take(values.len()).enumerate() {
                let weight = gamma * f64::from(*weight);
                value += weight * values[input];
                error += weight.abs() * errors[input];
                for (slope, own) in slope.iter_mut().zip(slopes[input]) {
                    *slope += weight * own;
                }
            }
            (value, slope, error)
        };
        for (layer, linear) in layout.layers.iter().enumerate().take(SHAPE_LAYERS) {
            let mut next = (Vec::new(), Vec::new(), Vec::new());
            for unit in 0..width {
                let gamma = f64::from(film[2 * layer * width + unit]);
                let offset = gamma * f64::from(weights[linear.bias.start + unit])
                    + f64::from(film[(2 * layer + 1) * width + unit]);
                let row = &weights[linear.weight.start + unit * linear.inputs..][..linear.inputs];
                let (value, slope, error) = affine(row, gamma, offset, &values, &slopes, &errors);
                let radius = slope.iter().map(|slope| slope.abs()).sum::<f64>() + error;
                let (sin, cos) = value.sin_cos();
                if cos.abs() * radius + radius * radius / 2.0 < 1.0 {
                    next.0.push(sin);
                    next.1.push(slope.map(|slope| slope * cos));
                    next.2.push(error * cos.abs() + radius * radius / 2.0);
                } else {
                    next.0.push(0.0);
                    next.1.push([0.0; 3]);
                    next.2.push(1.0);
                }
            }
            (values, slopes, errors) = next;
        }
        [&layout.mask, &layout.residual].map(|head| {
            let (_, slope, error) = affine(&weights[head.weight.clone()], 1.0, 0.0, &values, &slopes, &errors);
            slope.iter().map(|slope| slope.abs()).sum::<f64>() + error
        })
    }

    /// Median radii of the raw masks' logits (times the sharpness) and of Δd in world units.
    fn median_radii(field: &LocalField, cell: f64) -> [f64; 2] {
        let Fusion::Softmax { sharpness } = field.fusion else { panic!("the built-in model fuses by softmax") };
        let mut radii: [Vec<f64>; 2] = Default::default();
        for region in 0..8 {
            for place in 0..20 {
                let turn = f64::from(place) * 2.4;
                let centre = [0.5 * turn.cos(), 0.5 * turn.sin(), 0.04 * f64::from(place) - 0.4];
                let [mask, residual] = proven_radii(field, region, centre, cell / 2.0 * crate::camera::INPUT_SCALE);
                radii[0].push(mask * sharpness);
                radii[1].push(residual * field.residual_scale);
            }
        }
        radii.map(|mut radii| {
            radii.sort_by(f64::total_cmp);
            radii[radii.len() / 2]
        })
    }

    #[test]
    fn proven_bounds_of_a_cell_say_nothing_at_affordable_sizes() {
        let field = built_in_portrait();
        for cells in [56.0, 128.0, 256.0, 512.0, 1024.0] {
            let [logit, distance] = median_radii(&field, 0.3 / cells);
            println!("{cells} cells a side: mask logits ± {logit:.3}, Δd ± {distance:.5}");
        }
        let [_, distance] = median_radii(&field, 0.3 / (COARSE_CELLS * FINENESS) as f64);
        // Light falls by e within α: a distance known to no better than that says nothing of where the light is.
        assert!(distance * f64::from(field.inverse_alpha) > 1.0, "{distance}: use proven bounds after all");
        // The form itself is sound and, for tiny cells, tight: it shrinks with the cell.
        assert!(median_radii(&field, 1e-7)[1] < 1e-4);
    }
}
