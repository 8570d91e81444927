//! One region at the points of one tile, forwards and backwards, without leaving the second-level cache.
//!
//! Layers are counted from 0 here. With h_l = sin z_l, c_l = cos z_l and a head w on layer L, the spatial gradient is
//! the reverse sweep v_L = w, u_l = v_l ∘ c_l, v_{l-1} = A_lᵀ u_l, ∇ = v_{-1}. The backward pass recomputes all of it,
//! runs the sweep's adjoint upwards (leaving c̄_l), then the layers' downwards with z̄_l = h̄_l ∘ c_l − c̄_l ∘ h_l.

// One contract covers every function here: the processor has V's instructions, the tile's memory its layouts' sizes.
#![allow(clippy::missing_safety_doc)]

use std::ptr::null;

use super::{
    products::{
        AngleAdjoint, Left, PADDING, Sine, SineCosine, Store, SweepAdjoint, SweepAdjointAtHead, SweepStep, TILE,
        accumulate_outer, multiply, project,
    },
    region::{AngleBounds, FoldedLayout, GradientLayout, Plan, Sweep},
};
use crate::{
    FILM_LAYERS, SHAPE_LAYERS,
    simd::{LARGEST_ANGLE, Lanes},
};

static ONES: [f32; TILE] = [1.0; TILE];

/// Last layer of the shape branch.
const SHAPE_TOP: usize = SHAPE_LAYERS - 1;
/// Last layer of all.
const TOP: usize = FILM_LAYERS - 1;

/// A tile of one (image, region) with its memory.
pub struct Tile<'a> {
    pub plan: &'a Plan,
    pub layout: &'a FoldedLayout,
    pub folded: *const f32,
    pub bounds: AngleBounds,
    pub room: *mut f32,
}

/// Rows of a result or its upstream gradient: row r of point p is at `start + r · stride + p · point_stride`.
#[derive(Clone, Copy)]
pub struct ResultRows {
    pub start: *mut f32,
    pub stride: usize,
    /// 1, or the number of rows with a `stride` of 1.
    pub point_stride: usize,
}

/// Where a backward pass adds or leaves gradients.
pub struct TileGradients<'a> {
    pub layout: &'a GradientLayout,
    /// Added to.
    pub sums: *mut f32,
    /// Overwritten, one row of point columns a point; may be null.
    pub points: *mut f32,
}

impl Tile<'_> {
    /// Length of `room`.
    pub fn room_len(plan: &Plan) -> usize {
        5 * FILM_LAYERS * TILE * plan.padded + 4 * TILE * plan.padded + 64 * TILE
    }

    unsafe fn matrix(&self, index: usize) -> *mut f32 {
        // SAFETY: `room_len` has room for 5 · FILM_LAYERS + 4 matrices.
        unsafe { self.room.add(64 * TILE + index * TILE * self.plan.padded) }
    }

    unsafe fn sine(&self, layer: usize) -> *mut f32 {
        // SAFETY: as `matrix`; the same for those below.
        unsafe { self.matrix(layer) }
    }

    unsafe fn cosine(&self, layer: usize) -> *mut f32 {
        // SAFETY: see above.
        unsafe { self.matrix(FILM_LAYERS + layer) }
    }

    unsafe fn after(&self, layer: usize) -> *mut f32 {
        // SAFETY: see above.
        unsafe { self.matrix(2 * FILM_LAYERS + layer) }
    }

    unsafe fn before(&self, layer: usize) -> *mut f32 {
        // SAFETY: see above.
        unsafe { self.matrix(3 * FILM_LAYERS + layer) }
    }

    unsafe fn cosine_adjoint(&self, layer: usize) -> *mut f32 {
        // SAFETY: see above.
        unsafe { self.matrix(4 * FILM_LAYERS + layer) }
    }

    unsafe fn temporary(&self, index: usize) -> *mut f32 {
        // SAFETY: see above; four of them.
        unsafe { self.matrix(5 * FILM_LAYERS + index) }
    }

    /// The points as rows (x, y, z, 1, view, 0 …) of 16.
    fn inputs(&self) -> *mut f32 {
        self.room
    }

    /// Upstream gradients of the heads, one row of TILE each; at most five.
    unsafe fn head_upstream(&self, head: usize) -> *mut f32 {
        // SAFETY: the first 64 rows of TILE hold inputs (16), heads (5), sweeps (8) and a line (1).
        unsafe { self.room.add((16 + head) * TILE) }
    }

    /// Upstream gradients of a sweep's ∇, three rows of TILE and one of zeros.
    unsafe fn sweep_upstream(&self, sweep: usize) -> *mut f32 {
        // SAFETY: see above; at most two sweeps.
        unsafe { self.room.add((24 + 4 * sweep) * TILE) }
    }

    /// Room for one row of a result.
    unsafe fn line(&self) -> *mut f32 {
        // SAFETY: see above.
        unsafe { self.room.add(40 * TILE) }
    }

    unsafe fn folded(&self, offset: usize) -> *const f32 {
        // SAFETY: offsets come from the folded layout.
        unsafe { self.folded.add(offset) }
    }

    /// A tile's matrix as the left operand of a product over its columns.
    fn rows_of(&self, matrix: *const f32) -> Left {
        Left { start: matrix, row_stride: self.plan.padded, inner_stride: 1, inner: self.plan.shape.width }
    }

    /// A tile's matrix as the left operand of a product over its points.
    fn columns_of(&self, matrix: *const f32, rows: usize) -> Left {
        Left { start: matrix, row_stride: 1, inner_stride: self.plan.padded, inner: rows }
    }

    /// Takes in up to TILE points; returns the number of rows to compute and the largest |coordinate| (or NaN).
    #[inline(always)]
    unsafe fn load_points(&self, points: &[f32]) -> (usize, f32) {
        let columns = self.plan.shape.point_columns();
        let rows = (points.len() / columns).next_multiple_of(PADDING);
        let mut largest = 0u32;
        // SAFETY: at most TILE points, rows of PADDING values.
        unsafe {
            let inputs = std::slice::from_raw_parts_mut(self.inputs(), TILE * PADDING);
            inputs.fill(0.0);
            for (row, point) in inputs.chunks_exact_mut(PADDING).zip(points.chunks_exact(columns)) {
                row[..3].copy_from_slice(&point[..3]);
                row[3] = 1.0;
                row[4..][..columns - 3].copy_from_slice(&point[3..]);
                for coordinate in &row[..3] {
                    // Magnitudes order as integers, NaN above all.
                    largest = largest.max(coordinate.to_bits() & 0x7fff_ffff);
                }
            }
        }
        (rows, f32::from_bits(largest))
    }

    /// Layer `layer` from `input` to `sine` and, unless null, `cosine`.
    #[inline(always)]
    unsafe fn layer<V: Lanes, const ROWS: usize>(
        &self,
        layer: usize,
        (rows, largest_coordinate): (usize, f32),
        input: *const f32,
        sine: *mut f32,
        cosine: *mut f32,
    ) {
        // SAFETY: the folded layout's panels fit the left operands.
        unsafe {
            let (left, panels, offset, bound) = match layer {
                0 => (
                    Left { start: input, row_stride: PADDING, inner_stride: 1, inner: 4 },
                    self.folded(self.layout.first_panels),
                    null(),
                    self.bounds.first_slope * largest_coordinate + self.bounds.first_offset,
                ),
                _ => (
                    self.rows_of(input),
                    self.folded(self.layout.forward[layer - 1]),
                    self.folded(self.layout.offset[layer - 1]),
                    self.bounds.deeper,
                ),
            };
            let padded = self.plan.padded;
            if bound <= LARGEST_ANGLE {
                if cosine.is_null() {
                    multiply::<V, ROWS, _>(rows, padded, left, panels, offset, Sine(sine));
                } else {
                    multiply::<V, ROWS, _>(rows, padded, left, panels, offset, SineCosine { sine, cosine });
                }
            } else {
                multiply::<V, ROWS, _>(rows, padded, left, panels, offset, Store(sine));
                exact_sine_cosine(sine, cosine, rows * padded);
            }
        }
    }

    /// Writes the tile's rows of the result. `points` holds at most TILE points.
    #[inline(always)]
    pub unsafe fn forward<V: Lanes, const ROWS: usize>(&self, points: &[f32], result: ResultRows) {
        let plan = self.plan;
        let count = points.len() / plan.shape.point_columns();
        // SAFETY: the caller's promise on `result`, this tile's layouts otherwise.
        unsafe {
            let extent = self.load_points(points);
            let rows = extent.0;
            let sweeping = !plan.sweeps.is_empty();
            let mut input = self.inputs().cast_const();
            for layer in 0..plan.depth {
                // Without sweeps two matrices are enough, and stay in the first-level cache.
                let sine = self.sine(if sweeping { layer } else { layer % 2 });
                let cosine = if sweeping { self.cosine(layer) } else { std::ptr::null_mut() };
                self.layer::<V, ROWS>(layer, extent, input, sine, cosine);
                let heads = match layer {
                    SHAPE_TOP => 0..plan.shape_heads,
                    TOP => plan.shape_heads..plan.heads.len(),
                    _ => 0..0,
                };
                for head in heads {
                    project::<V>(
                        rows,
                        plan.padded,
                        sine,
                        self.folded(self.layout.heads + head * plan.padded),
                        self.inputs(),
                        self.folded(self.layout.tails + head * PADDING),
                        self.line(),
                    );
                    self.emit(count, result, plan.heads[head].row);
                }
                input = sine;
            }
            for sweep in &plan.sweeps {
                self.sweep::<V, ROWS>(sweep, rows, false);
                for axis in 0..3 {
                    let row = self.folded(self.layout.first + axis * plan.padded);
                    project::<V>(rows, plan.padded, self.after(0), row, null(), null(), self.line());
                    self.emit(count, result, sweep.row + axis);
                }
            }
            if let Some(activations) = &plan.rows.activations {
                let target = result.start.add(activations.start * result.stride);
                if result.stride == 1 {
                    for point in 0..count {
                        let (source, target) =
                            (input.add(point * plan.padded), target.add(point * result.point_stride));
                        std::ptr::copy_nonoverlapping(source, target, plan.shape.width);
                    }
                } else {
                    for column in 0..plan.shape.width {
                        let target = target.add(column * result.stride);
                        for point in 0..count {
                            *target.add(point * result.point_stride) = *input.add(point * plan.padded + column);
                        }
                    }
                }
            }
        }
    }

    #[inline(always)]
    unsafe fn emit(&self, count: usize, result: ResultRows, row: usize) {
        // SAFETY: the result has `count` points from `start` in every row.
        unsafe {
            let target = result.start.add(row * result.stride);
            if result.point_stride == 1 {
                std::ptr::copy_nonoverlapping(self.line(), target, count);
            } else {
                for point in 0..count {
                    *target.add(point * result.point_stride) = *self.line().add(point);
                }
            }
        }
    }

    /// The reverse sweep of a head down to u_0 in `after(0)`; `keep`: leaves v_l in `before(l)` for all l below the head.
    #[inline(always)]
    unsafe fn sweep<V: Lanes, const ROWS: usize>(&self, sweep: &Sweep, rows: usize, keep: bool) {
        let padded = self.plan.padded;
        let top = sweep.depth - 1;
        // SAFETY: this tile's layouts.
        unsafe {
            let weight = self.folded(self.layout.heads + sweep.head * padded);
            let (cosine, after) = (self.cosine(top), self.after(top));
            for row in 0..rows {
                let mut column = 0;
                while column < padded {
                    let at = row * padded + column;
                    V::load(weight.add(column)).mul(V::load(cosine.add(at))).store(after.add(at));
                    column += V::COUNT;
                }
            }
            for layer in (0..top).rev() {
                let epilogue = SweepStep {
                    cosine: self.cosine(layer),
                    before: if keep { self.before(layer) } else { std::ptr::null_mut() },
                    after: self.after(layer),
                };
                let left = self.rows_of(self.after(layer + 1));
                multiply::<V, ROWS, _>(rows, padded, left, self.folded(self.layout.reverse[layer]), null(), epilogue);
            }
        }
    }

    /// Adds the tile's share of the gradients of Σ upstream ∘ result.
    #[inline(always)]
    pub unsafe fn backward<V: Lanes, const ROWS: usize>(
        &self,
        points: &[f32],
        upstream: ResultRows,
        gradients: &TileGradients<'_>,
    ) {
        let plan = self.plan;
        let padded = plan.padded;
        let count = points.len() / plan.shape.point_columns();
        let swept_depth = plan.sweeps.iter().map(|sweep| sweep.depth).max().unwrap_or(0);
        // SAFETY: the caller's promise on `upstream` and `gradients`, this tile's layouts otherwise.
        unsafe {
            let extent = self.load_points(points);
            let rows = extent.0;
            self.load_upstream(count, upstream);
            for layer in 0..plan.depth {
                let input = if layer == 0 { self.inputs() } else { self.sine(layer - 1) };
                self.layer::<V, ROWS>(layer, extent, input, self.sine(layer), self.cosine(layer));
            }
            for layer in 0..swept_depth {
                std::ptr::write_bytes(self.cosine_adjoint(layer), 0, rows * padded);
            }
            for (index, sweep) in plan.sweeps.iter().enumerate() {
                self.sweep::<V, ROWS>(sweep, rows, true);
                self.sweep_adjoint::<V, ROWS>(index, sweep, rows, gradients);
            }
            self.head_gradients::<V, ROWS>(rows, gradients);

            let angle_adjoint = |layer: usize, addend: *const f32, target: *mut f32| AngleAdjoint {
                addend,
                sine: self.sine(layer),
                cosine: self.cosine(layer),
                cosine_adjoint: if layer < swept_depth { self.cosine_adjoint(layer) } else { null() },
                target,
            };
            let mut current = self.temporary(0);
            let mut next = self.temporary(1);
            let top = plan.depth - 1;
            let activations = match plan.rows.activations {
                Some(_) => self.temporary(2).cast_const(),
                None => null(),
            };
            let (left, panels) = if top == TOP { self.texture_heads() } else { self.shape_heads() };
            multiply::<V, ROWS, _>(rows, padded, left, panels, null(), angle_adjoint(top, activations, current));
            for layer in (0..top).rev() {
                let left = self.columns_of(current, rows);
                let matrix = gradients.sums.add(gradients.layout.matrix[layer]);
                accumulate_outer::<V, ROWS>(plan.shape.width, padded, left, self.sine(layer), matrix);
                self.accumulate_points::<V, ROWS>(rows, current, gradients.sums.add(gradients.layout.offset[layer]));
                let mut addend = null();
                if layer == SHAPE_TOP {
                    let (left, panels) = self.shape_heads();
                    multiply::<V, ROWS, _>(rows, padded, left, panels, null(), Store(self.temporary(3)));
                    addend = self.temporary(3).cast_const();
                }
                let panels = self.folded(self.layout.reverse[layer]);
                let epilogue = angle_adjoint(layer, addend, next);
                multiply::<V, ROWS, _>(rows, padded, self.rows_of(current), panels, null(), epilogue);
                (current, next) = (next, current);
            }
            let inputs = Left { start: self.inputs(), row_stride: 1, inner_stride: PADDING, inner: rows };
            accumulate_outer::<V, ROWS>(4, padded, inputs, current, gradients.sums.add(gradients.layout.first));
            if !gradients.points.is_null() {
                self.point_gradients::<V>((rows, count), current, gradients.points);
            }
        }
    }

    /// Takes in the upstream gradients, zero beyond the tile's `count` points.
    #[inline(always)]
    unsafe fn load_upstream(&self, count: usize, upstream: ResultRows) {
        let plan = self.plan;
        debug_assert_eq!(upstream.point_stride, 1);
        // SAFETY: `upstream` has `count` points from `start` in every row; the targets hold TILE each.
        unsafe {
            let load = |row: usize, target: *mut f32| {
                std::ptr::write_bytes(target, 0, TILE);
                std::ptr::copy_nonoverlapping(upstream.start.add(row * upstream.stride), target, count);
            };
            for (index, head) in plan.heads.iter().enumerate() {
                load(head.row, self.head_upstream(index));
            }
            for (index, sweep) in plan.sweeps.iter().enumerate() {
                for axis in 0..3 {
                    load(sweep.row + axis, self.sweep_upstream(index).add(axis * TILE));
                }
                std::ptr::write_bytes(self.sweep_upstream(index).add(3 * TILE), 0, TILE);
            }
            if let Some(activations) = &plan.rows.activations {
                let target = self.temporary(2);
                std::ptr::write_bytes(target, 0, TILE * plan.padded);
                for column in 0..plan.shape.width {
                    let source = upstream.start.add((activations.start + column) * upstream.stride);
                    for point in 0..count {
                        *target.add(point * plan.padded + column) = *source.add(point);
                    }
                }
            }
        }
    }

    /// The double backward: from the upstream of ∇ up to the head, leaving c̄.
    #[inline(always)]
    unsafe fn sweep_adjoint<V: Lanes, const ROWS: usize>(
        &self,
        index: usize,
        sweep: &Sweep,
        rows: usize,
        gradients: &TileGradients<'_>,
    ) {
        let (width, padded) = (self.plan.shape.width, self.plan.padded);
        let top = sweep.depth - 1;
        // SAFETY: this tile's layouts.
        unsafe {
            let upstream = self.sweep_upstream(index);
            let (mut current, mut next) = (self.temporary(0), self.temporary(1));
            let per_axis = Left { start: upstream, row_stride: TILE, inner_stride: 1, inner: rows };
            let first = gradients.sums.add(gradients.layout.first);
            accumulate_outer::<V, ROWS>(3, padded, per_axis, self.after(0), first);
            // The fourth row, zero, meets the offset in the first layer's panels.
            let per_point = Left { start: upstream, row_stride: 1, inner_stride: TILE, inner: 4 };
            let step = |layer: usize, before_adjoint: *mut f32| SweepAdjoint {
                cosine: self.cosine(layer),
                before: self.before(layer),
                before_adjoint,
                cosine_adjoint: self.cosine_adjoint(layer),
            };
            let panels = self.folded(self.layout.first_panels);
            multiply::<V, ROWS, _>(rows, padded, per_point, panels, null(), step(0, current));
            for layer in 1..=top {
                let after = self.columns_of(self.after(layer), rows);
                let matrix = gradients.sums.add(gradients.layout.matrix[layer - 1]);
                accumulate_outer::<V, ROWS>(width, padded, after, current, matrix);
                let (left, panels) = (self.rows_of(current), self.folded(self.layout.forward[layer - 1]));
                if layer < top {
                    multiply::<V, ROWS, _>(rows, padded, left, panels, null(), step(layer, next));
                } else {
                    let epilogue = SweepAdjointAtHead {
                        cosine: self.cosine(top),
                        weight: self.folded(self.layout.heads + sweep.head * padded),
                        weight_adjoint: next,
                        cosine_adjoint: self.cosine_adjoint(top),
                    };
                    multiply::<V, ROWS, _>(rows, padded, left, panels, null(), epilogue);
                }
                (current, next) = (next, current);
            }
            let head = gradients.sums.add(gradients.layout.heads + sweep.head * padded);
            self.accumulate_points::<V, ROWS>(rows, current, head);
        }
    }

    /// target[c] += Σ_p matrix[p][c]
    #[inline(always)]
    unsafe fn accumulate_points<V: Lanes, const ROWS: usize>(&self, rows: usize, matrix: *const f32, target: *mut f32) {
        let ones = Left { start: ONES.as_ptr(), row_stride: 0, inner_stride: 1, inner: rows };
        // SAFETY: the caller's promise.
        unsafe { accumulate_outer::<V, ROWS>(1, self.plan.padded, ones, matrix, target) }
    }

    /// Gradients of the heads' weights, biases and view columns.
    #[inline(always)]
    unsafe fn head_gradients<V: Lanes, const ROWS: usize>(&self, rows: usize, gradients: &TileGradients<'_>) {
        let plan = self.plan;
        let (padded, heads) = (plan.padded, plan.heads.len());
        // SAFETY: this tile's layouts.
        unsafe {
            let from =
                |head: usize| Left { start: self.head_upstream(head), row_stride: TILE, inner_stride: 1, inner: rows };
            let weights = gradients.sums.add(gradients.layout.heads);
            accumulate_outer::<V, ROWS>(plan.shape_heads, padded, from(0), self.sine(SHAPE_TOP), weights);
            if heads > plan.shape_heads {
                let weights = weights.add(plan.shape_heads * padded);
                let (upstream, count) = (from(plan.shape_heads), heads - plan.shape_heads);
                accumulate_outer::<V, ROWS>(count, padded, upstream, self.sine(TOP), weights);
            }
            let tails = gradients.sums.add(gradients.layout.tails);
            accumulate_outer::<V, ROWS>(heads, PADDING, from(0), self.inputs(), tails);
        }
    }

    /// The operands of h̄_3 = Σ upstream · weight over the heads at layer 3.
    unsafe fn shape_heads(&self) -> (Left, *const f32) {
        // SAFETY: this tile's layouts.
        unsafe { (self.upstream_of(0, self.plan.shape_heads), self.folded(self.layout.shape_head_panels)) }
    }

    /// The same over the heads at layer 5.
    unsafe fn texture_heads(&self) -> (Left, *const f32) {
        let (first, heads) = (self.plan.shape_heads, self.plan.heads.len());
        // SAFETY: this tile's layouts.
        unsafe { (self.upstream_of(first, heads - first), self.folded(self.layout.texture_head_panels)) }
    }

    unsafe fn upstream_of(&self, first: usize, inner: usize) -> Left {
        // SAFETY: this tile's layouts.
        unsafe { Left { start: self.head_upstream(first), row_stride: 1, inner_stride: TILE, inner } }
    }

    /// Gradients of the points, A_1ᵀ z̄_1, and of the view directions.
    #[inline(always)]
    unsafe fn point_gradients<V: Lanes>(
        &self,
        (rows, count): (usize, usize),
        angle_adjoint: *const f32,
        target: *mut f32,
    ) {
        let plan = self.plan;
        let columns = plan.shape.point_columns();
        // SAFETY: `target` holds `count` rows of `columns`; this tile's layouts otherwise.
        unsafe {
            for axis in 0..3 {
                let row = self.folded(self.layout.first + axis * plan.padded);
                project::<V>(rows, plan.padded, angle_adjoint, row, null(), null(), self.line());
                for point in 0..count {
                    *target.add(point * columns + axis) = *self.line().add(point);
                }
            }
            for column in 3..columns {
                for point in 0..count {
                    let mut sum = 0.0;
                    for head in 0..plan.heads.len() {
                        // A tail is (0, 0, 0, bias, view): zero where a head reads no view.
                        let weight = *self.folded(self.layout.tails + head * PADDING + column + 1);
                        sum += weight * *self.head_upstream(head).add(point);
                    }
                    *target.add(point * columns + column) = sum;
                }
            }
        }
    }
}

/// Sine and cosine of angles beyond [`LARGEST_ANGLE`], lane by lane in f64. `sine` holds the angles.
#[cold]
#[inline(never)]
unsafe fn exact_sine_cosine(sine: *mut f32, cosine: *mut f32, len: usize) {
    for index in 0..len {
        // SAFETY: the caller's matrices hold `len` values.
        unsafe {
            let (sin, cos) = f64::from(*sine.add(index)).sin_cos();
            *sine.add(index) = sin as f32;
            if !cosine.is_null() {
                *cosine.add(index) = cos as f32;
            }
        }
    }
}
