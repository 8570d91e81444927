//! A region's weights in the order the products read them: packed once a region, folded with FiLM once an (image,
//! region); and gradients on their way back.

use std::ops::{Deref, DerefMut};

use super::products::{PADDING, panel_columns};
use crate::{FILM_LAYERS, HeadShape, Layout, Outputs, Rows, SHAPE_LAYERS, simd::Lanes};

/// Values of FiLM for one (image, region): γ and β of every layer.
pub fn film_len(shape: HeadShape) -> usize {
    FILM_LAYERS * 2 * shape.width
}

/// One output of a head.
#[derive(Clone, Copy, Debug)]
pub struct Head {
    /// Where its weight's row lies in the packed row of weights.
    pub weight: usize,
    /// Where its bias lies.
    pub bias: usize,
    /// Whether three view columns follow the weight's row.
    pub view: bool,
    /// Its row of the result.
    pub row: usize,
}

/// A head whose spatial gradient is wanted.
#[derive(Clone, Copy, Debug)]
pub struct Sweep {
    /// Index among the heads.
    pub head: usize,
    /// The layer it reads.
    pub depth: usize,
    /// The gradient's first row of the result.
    pub row: usize,
}

/// Everything about an evaluation that does not depend on its numbers.
#[derive(Clone, Debug)]
pub struct Plan {
    pub shape: HeadShape,
    pub outputs: Outputs,
    pub layout: Layout,
    pub rows: Rows,
    /// Layers needed.
    pub depth: usize,
    /// Columns of a tile's matrices.
    pub padded: usize,
    /// Those that read layer 3, then those that read layer 5.
    pub heads: Vec<Head>,
    /// How many of the heads read layer 3.
    pub shape_heads: usize,
    pub sweeps: Vec<Sweep>,
}

impl Plan {
    pub fn new(shape: HeadShape, outputs: Outputs) -> Self {
        let (layout, rows) = (shape.layout(), shape.rows(outputs));
        let depth = shape.depth(outputs);
        let residual_depth = shape.residual_depth();
        let head = |linear: &crate::Linear, output: usize, first_row: usize| Head {
            weight: linear.weight.start + output * linear.inputs,
            bias: linear.bias.start + output,
            view: linear.inputs > shape.width,
            row: first_row + output,
        };
        let mut heads = vec![head(&layout.mask, 0, rows.mask), head(&layout.residual, 0, rows.residual)];
        if let Some(colour) = &rows.colour {
            heads.extend((0..3).map(|output| head(&layout.colour, output, colour.start)));
        }
        let mut sweeps = Vec::new();
        sweeps.extend(rows.mask_gradient.as_ref().map(|rows| Sweep { head: 0, depth: SHAPE_LAYERS, row: rows.start }));
        let residual = rows.residual_gradient.as_ref();
        sweeps.extend(residual.map(|rows| Sweep { head: 1, depth: residual_depth, row: rows.start }));
        Self {
            shape,
            outputs,
            rows,
            depth,
            padded: shape.width.next_multiple_of(PADDING),
            heads,
            shape_heads: if residual_depth == SHAPE_LAYERS { 2 } else { 1 },
            sweeps,
            layout,
        }
    }

    fn square(&self) -> usize {
        self.shape.width * self.padded
    }
}

/// f32 memory on cache lines: vectors that straddle two cost double.
#[derive(Default)]
pub struct Aligned(Vec<Line>);

#[derive(Clone, Copy, bytemuck::Zeroable, bytemuck::Pod)]
#[repr(C, align(64))]
struct Line([f32; 16]);

impl Aligned {
    pub fn zeros(len: usize) -> Self {
        let mut memory = Self::default();
        memory.grow(len);
        memory
    }

    /// At least `len` values; new ones are zero, old ones stay.
    pub fn grow(&mut self, len: usize) {
        let lines = len.div_ceil(16);
        if lines > self.0.len() {
            self.0.resize(lines, Line([0.0; 16]));
        }
    }
}

impl Deref for Aligned {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        bytemuck::cast_slice(&self.0)
    }
}

impl DerefMut for Aligned {
    fn deref_mut(&mut self) -> &mut [f32] {
        bytemuck::cast_slice_mut(&mut self.0)
    }
}

/// One region's weights before FiLM, padded and in both orders.
pub struct PackedRegion {
    /// W_1ᵀ: three rows of `padded`.
    first: Aligned,
    /// W_lᵀ of layers 2 to `depth`, W x padded each.
    transposed: Aligned,
    /// W_l of layers 2 to `depth`, W x padded each.
    straight: Aligned,
    /// b_l, `padded` each.
    bias: Aligned,
    /// Σ_c |W_l[o][c]|, `padded` each.
    row_norm: Aligned,
}

impl PackedRegion {
    pub fn new(plan: &Plan, weights: &[f32]) -> Self {
        let (width, padded, depth) = (plan.shape.width, plan.padded, plan.depth);
        let square = plan.square();
        let mut packed = Self {
            first: Aligned::zeros(3 * padded),
            transposed: Aligned::zeros((depth - 1) * square),
            straight: Aligned::zeros((depth - 1) * square),
            bias: Aligned::zeros(depth * padded),
            row_norm: Aligned::zeros(depth * padded),
        };
        for (layer, linear) in plan.layout.layers.iter().enumerate().take(depth) {
            let weight = &weights[linear.weight.clone()];
            packed.bias[layer * padded..][..width].copy_from_slice(&weights[linear.bias.clone()]);
            for (unit, row) in weight.chunks_exact(linear.inputs).enumerate() {
                packed.row_norm[layer * padded + unit] = row.iter().map(|weight| weight.abs()).sum();
                let (transposed, start) = match layer {
                    0 => (&mut packed.first, 0),
                    _ => (&mut packed.transposed, (layer - 1) * square),
                };
                for (input, &weight) in row.iter().enumerate() {
                    transposed[start + input * padded + unit] = weight;
                }
                if layer > 0 {
                    packed.straight[(layer - 1) * square + unit * padded..][..width].copy_from_slice(row);
                }
            }
        }
        packed
    }
}

/// Offsets into the memory of one (image, region)'s weights with FiLM folded in: A = γ ∘ W, a = γ ∘ b + β.
pub struct FoldedLayout {
    /// A_1ᵀ and a_1, four rows.
    pub first: usize,
    /// The same as panels.
    pub first_panels: usize,
    /// Layers 2 to 5: Aᵀ in panels, for h ↦ A h.
    pub forward: [usize; FILM_LAYERS - 1],
    /// Layers 2 to 5: A in panels, for u ↦ Aᵀ u.
    pub reverse: [usize; FILM_LAYERS - 1],
    /// Layers 2 to 5: a.
    pub offset: [usize; FILM_LAYERS - 1],
    /// The heads' weights, one row each.
    pub heads: usize,
    /// The heads' (0, 0, 0, bias, view…), matching a tile's inputs (x, y, z, 1, view…), one row of 16 each.
    pub tails: usize,
    /// The weights of the heads at layer 3 as panels.
    pub shape_head_panels: usize,
    /// The weights of the heads at layer 5 as panels.
    pub texture_head_panels: usize,
    /// Two rows of room for γ and β.
    film: usize,
    pub len: usize,
}

impl FoldedLayout {
    pub fn new(plan: &Plan) -> Self {
        let mut len = 0;
        let mut take = |count: usize| {
            len += count;
            len - count
        };
        let (padded, square, heads) = (plan.padded, plan.square(), plan.heads.len());
        Self {
            first: take(4 * padded),
            first_panels: take(4 * padded),
            forward: std::array::from_fn(|_| take(square)),
            reverse: std::array::from_fn(|_| take(square)),
            offset: std::array::from_fn(|_| take(padded)),
            heads: take(heads * padded),
            tails: take(heads * PADDING),
            shape_head_panels: take(plan.shape_heads * padded),
            texture_head_panels: take((heads - plan.shape_heads) * padded),
            film: take(2 * padded),
            len,
        }
    }
}

/// Bounds of a folded region's angles.
#[derive(Clone, Copy, Debug)]
pub struct AngleBounds {
    /// |z_1| ≤ `first_slope` · max |x_c| + `first_offset`.
    pub first_slope: f32,
    pub first_offset: f32,
    /// |z_l| ≤ `deeper` for all other layers, whose inputs are sines.
    pub deeper: f32,
}

/// Writes row `index` of a matrix of `count` rows into its panels, each value times `scale` of its column.
///
/// # Safety
/// The processor has V's instructions; `panels` holds `count` x `columns` values, `row` and `scale` `columns`.
#[inline(always)]
unsafe fn scatter_row<V: Lanes>(
    panels: *mut f32,
    (index, count): (usize, usize),
    columns: usize,
    row: *const f32,
    scale: impl Scale,
) {
    let mut column = 0;
    while column < columns {
        let panel = panel_columns::<V>(columns - column);
        let mut lane = 0;
        while lane < panel {
            // SAFETY: the panel at `column` has `count` rows of `panel` values and starts at column · count.
            unsafe {
                let value = V::load(row.add(column + lane)).mul(scale.at(column + lane));
                value.store(panels.add(column * count + index * panel + lane));
            }
            lane += V::COUNT;
        }
        column += panel;
    }
}

/// Factors of a row's columns.
trait Scale {
    /// # Safety
    /// As [`Lanes`]; `column` is within the row.
    unsafe fn at<V: Lanes>(&self, column: usize) -> V;
}

/// One factor for all columns.
struct Uniform(f32);

impl Scale for Uniform {
    #[inline(always)]
    unsafe fn at<V: Lanes>(&self, _column: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::splat(self.0) }
    }
}

/// A factor for each column.
struct PerColumn(*const f32);

impl Scale for PerColumn {
    #[inline(always)]
    unsafe fn at<V: Lanes>(&self, column: usize) -> V {
        // SAFETY: the caller's promise.
        unsafe { V::load(self.0.add(column)) }
    }
}

/// Folds one image's FiLM (`film`: [5, 2, W]) into a region's weights. `reverse`: also the panels reverse sweeps need.
///
/// # Safety
/// The processor has V's instructions.
#[inline(always)]
pub unsafe fn fold<V: Lanes>(
    plan: &Plan,
    packed: &PackedRegion,
    weights: &[f32],
    film: &[f32],
    folded: &mut Aligned,
    reverse: bool,
) -> AngleBounds {
    let (width, padded, square) = (plan.shape.width, plan.padded, plan.square());
    let layout = FoldedLayout::new(plan);
    folded.grow(layout.len);
    let mut bounds = AngleBounds { first_slope: 0.0, first_offset: 0.0, deeper: 0.0 };
    for layer in 0..plan.depth {
        let (gamma_at, beta_at) = (layout.film, layout.film + padded);
        folded[gamma_at..beta_at + padded].fill(0.0);
        folded[gamma_at..][..width].copy_from_slice(&film[2 * layer * width..][..width]);
        folded[beta_at..][..width].copy_from_slice(&film[(2 * layer + 1) * width..][..width]);
        let offset_at = if layer == 0 { layout.first + 3 * padded } else { layout.offset[layer - 1] };
        for unit in 0..padded {
            let gamma = folded[gamma_at + unit];
            let offset = gamma * packed.bias[layer * padded + unit] + folded[beta_at + unit];
            folded[offset_at + unit] = offset;
            let slope = gamma.abs() * packed.row_norm[layer * padded + unit];
            if layer == 0 {
                bounds.first_slope = max_or_nan(bounds.first_slope, slope);
                bounds.first_offset = max_or_nan(bounds.first_offset, offset.abs());
            } else {
                bounds.deeper = max_or_nan(bounds.deeper, slope + offset.abs());
            }
        }
        let base = folded.as_mut_ptr();
        // SAFETY: FoldedLayout's and PackedRegion's sizes; columns are padded to a multiple of the lanes.
        unsafe {
            let scale = base.add(gamma_at);
            if layer == 0 {
                for input in 0..3 {
                    let row = base.add(layout.first + input * padded);
                    let mut column = 0;
                    while column < padded {
                        let weight = V::load(packed.first.as_ptr().add(input * padded + column));
                        weight.mul(V::load(scale.add(column))).store(row.add(column));
                        column += V::COUNT;
                    }
                }
                for input in 0..4 {
                    let row = base.add(layout.first + input * padded);
                    scatter_row::<V>(base.add(layout.first_panels), (input, 4), padded, row, Uniform(1.0));
                }
            } else {
                let start = (layer - 1) * square;
                for input in 0..width {
                    let row = packed.transposed.as_ptr().add(start + input * padded);
                    let panels = base.add(layout.forward[layer - 1]);
                    scatter_row::<V>(panels, (input, width), padded, row, PerColumn(scale));
                }
                if reverse {
                    for (unit, &gamma) in film[2 * layer * width..][..width].iter().enumerate() {
                        let row = packed.straight.as_ptr().add(start + unit * padded);
                        let panels = base.add(layout.reverse[layer - 1]);
                        scatter_row::<V>(panels, (unit, width), padded, row, Uniform(gamma));
                    }
                }
            }
        }
    }
    for (index, head) in plan.heads.iter().enumerate() {
        let row = layout.heads + index * padded;
        folded[row..][..padded].fill(0.0);
        folded[row..][..width].copy_from_slice(&weights[head.weight..][..width]);
        let tail = layout.tails + index * PADDING;
        folded[tail..][..PADDING].fill(0.0);
        folded[tail + 3] = weights[head.bias];
        if head.view {
            folded[tail + 4..][..3].copy_from_slice(&weights[head.weight + width..][..3]);
        }
        let (panels, place) = if index < plan.shape_heads {
            (layout.shape_head_panels, (index, plan.shape_heads))
        } else {
            (layout.texture_head_panels, (index - plan.shape_heads, plan.heads.len() - plan.shape_heads))
        };
        let base = folded.as_mut_ptr();
        // SAFETY: as above.
        unsafe { scatter_row::<V>(base.add(panels), place, padded, base.add(row), Uniform(1.0)) };
    }
    bounds
}

/// The larger; NaN if either is, so that a bound never hides one.
fn max_or_nan(left: f32, right: f32) -> f32 {
    if left.is_nan() || left > right { left } else { right }
}

/// Offsets into the memory where one task sums its gradients of A, a and the heads.
pub struct GradientLayout {
    /// A_1ᵀ and a_1, four rows of `padded`.
    pub first: usize,
    /// Layers 2 to 5: A, W x padded.
    pub matrix: [usize; FILM_LAYERS - 1],
    /// Layers 2 to 5: a.
    pub offset: [usize; FILM_LAYERS - 1],
    /// The heads' weights, one row each.
    pub heads: usize,
    /// The heads' tails, one row of 16 each.
    pub tails: usize,
    pub len: usize,
}

impl GradientLayout {
    pub fn new(plan: &Plan) -> Self {
        let mut len = 0;
        let mut take = |count: usize| {
            len += count;
            len - count
        };
        let (padded, square, heads) = (plan.padded, plan.square(), plan.heads.len());
        Self {
            first: take(4 * padded),
            matrix: std::array::from_fn(|_| take(square)),
            offset: std::array::from_fn(|_| take(padded)),
            heads: take(heads * padded),
            tails: take(heads * PADDING),
            len,
        }
    }
}

/// From the gradients of A, a and the heads to those of the packed weights and of γ, β; overwrites both.
///
/// # Safety
/// The processor has V's instructions.
#[inline(always)]
pub unsafe fn unfold<V: Lanes>(
    plan: &Plan,
    packed: &PackedRegion,
    film: &[f32],
    gradient: &[f32],
    weights_gradient: &mut [f32],
    film_gradient: &mut [f32],
) {
    let (width, padded, square) = (plan.shape.width, plan.padded, plan.square());
    let layout = GradientLayout::new(plan);
    weights_gradient.fill(0.0);
    film_gradient.fill(0.0);
    for (layer, linear) in plan.layout.layers.iter().enumerate().take(plan.depth) {
        let offset_at = if layer == 0 { layout.first + 3 * padded } else { layout.offset[layer - 1] };
        for unit in 0..width {
            let gamma = film[2 * layer * width + unit];
            let offset = gradient[offset_at + unit];
            let row = &mut weights_gradient[linear.weight.start + unit * linear.inputs..][..linear.inputs];
            let product = if layer == 0 {
                let mut product = 0.0;
                for (input, target) in row.iter_mut().enumerate() {
                    let value = gradient[layout.first + input * padded + unit];
                    *target = gamma * value;
                    product += value * packed.first[input * padded + unit];
                }
                product
            } else {
                let matrix = &gradient[layout.matrix[layer - 1] + unit * padded..][..padded];
                for (target, value) in row.iter_mut().zip(matrix) {
                    *target = gamma * value;
                }
                let straight = &packed.straight[(layer - 1) * square + unit * padded..][..padded];
                // SAFETY: both rows hold `padded` values.
                unsafe { dot::<V>(matrix, straight) }
            };
            weights_gradient[linear.bias.start + unit] = gamma * offset;
            film_gradient[2 * layer * width + unit] = product + offset * packed.bias[layer * padded + unit];
            film_gradient[(2 * layer + 1) * width + unit] = offset;
        }
    }
    for (index, head) in plan.heads.iter().enumerate() {
        let row = &gradient[layout.heads + index * padded..][..width];
        weights_gradient[head.weight..][..width].copy_from_slice(row);
        let tail = &gradient[layout.tails + index * PADDING..][..PADDING];
        weights_gradient[head.bias] = tail[3];
        if head.view {
            weights_gradient[head.weight + width..][..3].copy_from_slice(&tail[4..7]);
        }
    }
}

/// Σ left ∘ right over rows of the same length, a multiple of 16.
///
/// # Safety
/// The processor has V's instructions.
#[inline(always)]
unsafe fn dot<V: Lanes>(left: &[f32], right: &[f32]) -> f32 {
    let mut lanes = [0f32; PADDING];
    // SAFETY: the lanes divide the rows' length; `lanes` has at least one vector.
    unsafe {
        let mut sum = V::splat(0.0);
        for (left, right) in left.chunks_exact(V::COUNT).zip(right.chunks_exact(V::COUNT)) {
            sum = V::load(left.as_ptr()).mul_add(V::load(right.as_ptr()), sum);
        }
        sum.store(lanes.as_mut_ptr());
    }
    lanes.iter().sum()
}
