//! The three matrix products of a tile, with everything that follows a product done while it is still in registers.
//!
//! A tile's matrices are point-major: one row a point, [`PADDING`]-padded columns along the lanes. Broadcasting the
//! left operand then needs no transposition in any of the passes: forward and reverse sweeps multiply by packed
//! panels of weights, weight gradients multiply two tile matrices.

// One contract covers every function here, stated at `Lanes`; pointers must be valid for the stated sizes.
#![allow(clippy::missing_safety_doc, clippy::too_many_arguments)]

use crate::simd::{Lanes, cos, sin};

/// Points of a full tile: with a width near 48 a tile's matrices stay in the first-level cache.
pub const TILE: usize = 48;
/// Columns are padded to a multiple of this; the lanes of every instruction set divide it.
pub const PADDING: usize = 16;
/// Rows of a block of registers that is four vectors wide: as many sums as eight rows of three.
const FOUR_VECTORS_ROWS: usize = 6;

/// The left operand of a product: element (row, inner) is at `start + row · row_stride + inner · inner_stride`.
#[derive(Clone, Copy)]
pub struct Left {
    pub start: *const f32,
    pub row_stride: usize,
    pub inner_stride: usize,
    pub inner: usize,
}

/// What becomes of a product's vector once it is complete.
pub trait Epilogue {
    /// `at` is its offset in a tile's matrix, `column` its first column.
    unsafe fn apply<V: Lanes>(&self, at: usize, column: usize, product: V);
}

/// Vectors of the next block of columns: whole blocks, but never a lone vector behind one that could share.
#[inline(always)]
fn next_block<V: Lanes>(columns_left: usize) -> usize {
    let vectors = columns_left / V::COUNT;
    if vectors == V::BLOCK_VECTORS + 1 { V::BLOCK_VECTORS - 1 } else { vectors.min(V::BLOCK_VECTORS) }
}

/// Columns of the next panel of a packed matrix. Panels lie one after another, each row-major.
#[inline(always)]
pub fn panel_columns<V: Lanes>(columns_left: usize) -> usize {
    next_block::<V>(columns_left) * V::COUNT
}

/// epilogue(offset + left · panels) for `rows` x `columns` (a multiple of 16); `offset`, one value a column, may be null.
/// Blocks have `ROWS` rows, or [`FOUR_VECTORS_ROWS`], which divide [`TILE`]: the last may run over, never beyond a tile.
#[inline(always)]
pub unsafe fn multiply<V: Lanes, const ROWS: usize, E: Epilogue>(
    rows: usize,
    columns: usize,
    left: Left,
    panels: *const f32,
    offset: *const f32,
    epilogue: E,
) {
    let mut column = 0;
    while column < columns {
        let vectors = next_block::<V>(columns - column);
        // SAFETY: the panel of `column` starts after `column` columns of `inner` rows each.
        unsafe {
            let panel = panels.add(column * left.inner);
            match vectors {
                4 if V::BLOCK_VECTORS == 4 => {
                    multiply_panel::<V, FOUR_VECTORS_ROWS, 4, E>(rows, columns, column, left, panel, offset, &epilogue);
                }
                3 if V::BLOCK_VECTORS >= 3 => {
                    multiply_panel::<V, ROWS, 3, E>(rows, columns, column, left, panel, offset, &epilogue);
                }
                2 => multiply_panel::<V, ROWS, 2, E>(rows, columns, column, left, panel, offset, &epilogue),
                _ => multiply_panel::<V, ROWS, 1, E>(rows, columns, column, left, panel, offset, &epilogue),
            }
        }
        column += vectors * V::COUNT;
    }
}

#[inline(always)]
unsafe fn multiply_panel<V: Lanes, const ROWS: usize, const VECTORS: usize, E: Epilogue>(
    rows: usize,
    columns: usize,
    column: usize,
    left: Left,
    panel: *const f32,
    offset: *const f32,
    epilogue: &E,
) {
    let mut row = 0;
    while row < rows {
        // SAFETY: rows and columns of the block are within the operands, which the caller vouches for.
        unsafe {
            let mut sums = [[V::splat(0.0); VECTORS]; ROWS];
            if !offset.is_null() {
                sums = [load_all::<V, VECTORS>(offset.add(column)); ROWS];
            }
            let mut left_at = left.start.add(row * left.row_stride);
            let mut panel_at = panel;
            for _ in 0..left.inner {
                let right = load_all::<V, VECTORS>(panel_at);
                for (r, sums) in sums.iter_mut().enumerate() {
                    let scale = V::splat(*left_at.add(r * left.row_stride));
                    for (sum, right) in sums.iter_mut().zip(right) {
                        *sum = scale.mul_add(right, *sum);
                    }
                }
                left_at = left_at.add(left.inner_stride);
                panel_at = panel_at.add(VECTORS * V::COUNT);
            }
            for (r, sums) in sums.into_iter().enumerate() {
                for (v, sum) in sums.into_iter().enumerate() {
                    let column = column + v * V::COUNT;
                    epilogue.apply::<V>((row + r) * columns + column, column, sum);
                }
            }
        }
        row += ROWS;
    }
}

#[inline(always)]
unsafe fn load_all<V: Lanes, const VECTORS: usize>(source: *const f32) -> [V; VECTORS] {
    // SAFETY: the caller's promise.
    unsafe {
        let mut vectors = [V::splat(0.0); VECTORS];
        for (v, vector) in vectors.iter_mut().enumerate() {
            *vector = V::load(source.add(v * V::COUNT));
        }
        vectors
    }
}

/// target[o][c] += Σ_p left(p, o) · right[p][c] for `outputs` rows of any number and `columns`, a multiple of 16, the
/// row stride of both `right` and `target`. `left.inner` is the number of points, `left.row_stride` the outputs'.
#[inline(always)]
pub unsafe fn accumulate_outer<V: Lanes, const ROWS: usize>(
    outputs: usize,
    columns: usize,
    left: Left,
    right: *const f32,
    target: *mut f32,
) {
    let mut column = 0;
    while column < columns {
        let vectors = next_block::<V>(columns - column);
        // SAFETY: the blocks tile `target`.
        unsafe {
            let (right, target) = (right.add(column), target.add(column));
            match vectors {
                4 if V::BLOCK_VECTORS == 4 => {
                    outer_columns::<V, FOUR_VECTORS_ROWS, 4>(outputs, columns, left, right, target);
                }
                3 if V::BLOCK_VECTORS >= 3 => outer_columns::<V, ROWS, 3>(outputs, columns, left, right, target),
                2 => outer_columns::<V, ROWS, 2>(outputs, columns, left, right, target),
                _ => outer_columns::<V, ROWS, 1>(outputs, columns, left, right, target),
            }
        }
        column += vectors * V::COUNT;
    }
}

#[inline(always)]
unsafe fn outer_columns<V: Lanes, const ROWS: usize, const VECTORS: usize>(
    outputs: usize,
    columns: usize,
    left: Left,
    right: *const f32,
    target: *mut f32,
) {
    let mut output = 0;
    while output < outputs {
        let rest = outputs - output;
        let rows = if rest >= ROWS {
            ROWS
        } else if rest >= 4 {
            4
        } else if rest >= 2 {
            2
        } else {
            1
        };
        // SAFETY: rows and columns of the block are within the operands, which the caller vouches for.
        unsafe {
            let start = left.start.add(output * left.row_stride);
            let left = Left { start, ..left };
            let target = target.add(output * columns);
            match rows {
                1 => outer_block::<V, 1, VECTORS>(columns, left, right, target),
                2 => outer_block::<V, 2, VECTORS>(columns, left, right, target),
                4 => outer_block::<V, 4, VECTORS>(columns, left, right, target),
                _ => outer_block::<V, ROWS, VECTORS>(columns, left, right, target),
            }
        }
        output += rows;
    }
}

#[inline(always)]
unsafe fn outer_block<V: Lanes, const ROWS: usize, const VECTORS: usize>(
    columns: usize,
    left: Left,
    right: *const f32,
    target: *mut f32,
) {
    // SAFETY: the caller vouches for the block.
    unsafe {
        let mut sums = [[V::splat(0.0); VECTORS]; ROWS];
        let (mut left_at, mut right_at) = (left.start, right);
        for _ in 0..left.inner {
            let right = load_all::<V, VECTORS>(right_at);
            for (r, sums) in sums.iter_mut().enumerate() {
                let scale = V::splat(*left_at.add(r * left.row_stride));
                for (sum, right) in sums.iter_mut().zip(right) {
                    *sum = scale.mul_add(right, *sum);
                }
            }
            left_at = left_at.add(left.inner_stride);
            right_at = right_at.add(columns);
        }
        for (r, sums) in sums.into_iter().enumerate() {
            for (v, sum) in sums.into_iter().enumerate() {
                let at = target.add(r * columns + v * V::COUNT);
                V::load(at).add(sum).store(at);
            }
        }
    }
}

/// products[p] = Σ_c matrix[p][c] · row[c], plus Σ_c tail_matrix[p][c] · tail_row[c] over [`PADDING`] columns if
/// `tail_matrix` is not null; `points` is a multiple of 16.
#[inline(always)]
pub unsafe fn project<V: Lanes>(
    points: usize,
    columns: usize,
    matrix: *const f32,
    row: *const f32,
    tail_matrix: *const f32,
    tail_row: *const f32,
    products: *mut f32,
) {
    let mut partial = [0f32; 16 * 16];
    let mut point = 0;
    while point < points {
        // SAFETY: within the operands, which the caller vouches for; `partial` holds COUNT x COUNT values.
        unsafe {
            for p in 0..V::COUNT {
                let at = matrix.add((point + p) * columns);
                let mut sum = V::splat(0.0);
                let mut column = 0;
                while column < columns {
                    sum = V::load(row.add(column)).mul_add(V::load(at.add(column)), sum);
                    column += V::COUNT;
                }
                if !tail_matrix.is_null() {
                    let at = tail_matrix.add((point + p) * PADDING);
                    let mut column = 0;
                    while column < PADDING {
                        sum = V::load(tail_row.add(column)).mul_add(V::load(at.add(column)), sum);
                        column += V::COUNT;
                    }
                }
                sum.store(partial.as_mut_ptr().add(p * V::COUNT));
            }
            V::sum_rows(partial.as_ptr(), products.add(point));
        }
        point += V::COUNT;
    }
}

/// target = product
pub struct Store(pub *mut f32);

impl Epilogue for Store {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, _column: usize, product: V) {
        // SAFETY: `at` is within a tile's matrix.
        unsafe { product.store(self.0.add(at)) }
    }
}

/// target = sin(product)
pub struct Sine(pub *mut f32);

impl Epilogue for Sine {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, _column: usize, product: V) {
        // SAFETY: as above.
        unsafe { sin(product).store(self.0.add(at)) }
    }
}

/// sine = sin(product), cosine = cos(product)
pub struct SineCosine {
    pub sine: *mut f32,
    pub cosine: *mut f32,
}

impl Epilogue for SineCosine {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, _column: usize, product: V) {
        // SAFETY: as above.
        unsafe {
            sin(product).store(self.sine.add(at));
            cos(product).store(self.cosine.add(at));
        }
    }
}

/// One step of a reverse sweep: v = product (kept if `before` is not null), u = v ∘ cosine.
pub struct SweepStep {
    pub cosine: *const f32,
    pub before: *mut f32,
    pub after: *mut f32,
}

impl Epilogue for SweepStep {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, _column: usize, product: V) {
        // SAFETY: as above.
        unsafe {
            if !self.before.is_null() {
                product.store(self.before.add(at));
            }
            product.mul(V::load(self.cosine.add(at))).store(self.after.add(at));
        }
    }
}

/// One step of a reverse sweep's adjoint, with ū = product: v̄ = ū ∘ cosine, c̄ += ū ∘ v.
pub struct SweepAdjoint {
    pub cosine: *const f32,
    pub before: *const f32,
    pub before_adjoint: *mut f32,
    pub cosine_adjoint: *mut f32,
}

impl Epilogue for SweepAdjoint {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, _column: usize, product: V) {
        // SAFETY: as above.
        unsafe {
            product.mul(V::load(self.cosine.add(at))).store(self.before_adjoint.add(at));
            let cosine_adjoint = self.cosine_adjoint.add(at);
            product.mul_add(V::load(self.before.add(at)), V::load(cosine_adjoint)).store(cosine_adjoint);
        }
    }
}

/// [`SweepAdjoint`] at the sweep's head, where v is the head's weight, the same for all points.
pub struct SweepAdjointAtHead {
    pub cosine: *const f32,
    pub weight: *const f32,
    pub weight_adjoint: *mut f32,
    pub cosine_adjoint: *mut f32,
}

impl Epilogue for SweepAdjointAtHead {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, column: usize, product: V) {
        // SAFETY: as above; `weight` has one value a column.
        unsafe {
            product.mul(V::load(self.cosine.add(at))).store(self.weight_adjoint.add(at));
            let cosine_adjoint = self.cosine_adjoint.add(at);
            product.mul_add(V::load(self.weight.add(column)), V::load(cosine_adjoint)).store(cosine_adjoint);
        }
    }
}

/// The adjoint of an angle z from that of its sine, h̄ = product + addend: z̄ = h̄ ∘ cosine − c̄ ∘ sine.
/// `addend` and `cosine_adjoint` may be null.
pub struct AngleAdjoint {
    pub addend: *const f32,
    pub sine: *const f32,
    pub cosine: *const f32,
    pub cosine_adjoint: *const f32,
    pub target: *mut f32,
}

impl Epilogue for AngleAdjoint {
    #[inline(always)]
    unsafe fn apply<V: Lanes>(&self, at: usize, _column: usize, product: V) {
        // SAFETY: as above.
        unsafe {
            let sine_adjoint = if self.addend.is_null() { product } else { product.add(V::load(self.addend.add(at))) };
            let mut adjoint = sine_adjoint.mul(V::load(self.cosine.add(at)));
            if !self.cosine_adjoint.is_null() {
                let cosine_adjoint = V::load(self.cosine_adjoint.add(at));
                adjoint = cosine_adjoint.neg_mul_add(V::load(self.sine.add(at)), adjoint);
            }
            adjoint.store(self.target.add(at));
        }
    }
}
