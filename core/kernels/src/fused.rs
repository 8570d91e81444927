//! The fast kernel: each region as one fused pass over tiles of points, in the processor's widest instructions.
//!
//! FiLM is folded into packed weights once an (image, region); all five layers, heads, spatial gradients and, on the
//! way back, their recomputation run on a tile that stays in cache. Work is cut by sizes alone, never by the number
//! of threads, and partial gradients are summed in a fixed order: the same bits at any thread count.

use std::{cell::RefCell, ops::Range};

use rayon::prelude::*;

use self::{
    contribution::Contribution,
    products::TILE,
    region::{Aligned, AngleBounds, FoldedLayout, GradientLayout, PackedRegion, Plan, film_len, fold, unfold},
    tile::{ResultRows, Tile, TileGradients},
};
use super::{
    Evaluation, Extent, Gradients, HeadShape, Outputs, PreparedRegion, RegionKernel, check_length,
    prepared::{check_list, check_region},
    simd::Lanes,
};
use crate::{Error, Result};

mod contribution;
mod products;
mod region;
mod tile;

/// Points of a piece of work when an image has many: fifty tiles repay the folding.
const CHUNK_POINTS: usize = 50 * TILE;
/// Pieces of work that a backward pass is cut into at least, if there are points enough: each costs memory.
const BACKWARD_PIECES: usize = 64;
/// Partial gradients held at a time, in values (8 MiB: first touches of fresh memory cost more than the arithmetic).
const PARTIAL_VALUES: usize = 2 << 20;

/// The fused kernel for one instruction set.
pub struct Fused {
    name: &'static str,
    available: fn() -> bool,
    forward: unsafe fn(&mut Scratch, &Piece<'_>, Shared),
    backward: unsafe fn(&mut Scratch, &Piece<'_>, Upstream<'_>, &mut [f32], Shared),
    fold: unsafe fn(&Plan, &PackedRegion, &[f32], &[f32], &mut Aligned) -> AngleBounds,
    forward_list: unsafe fn(&mut Scratch, &Folded, &[f32], &mut [f32]),
}

/// One region of one image with FiLM folded in, see [`PreparedRegion`].
struct Folded {
    plan: Plan,
    layout: FoldedLayout,
    folded: Aligned,
    bounds: AngleBounds,
    forward_list: unsafe fn(&mut Scratch, &Folded, &[f32], &mut [f32]),
}

impl PreparedRegion<f32> for Folded {
    fn shape(&self) -> HeadShape {
        self.plan.shape
    }

    fn outputs(&self) -> Outputs {
        self.plan.outputs
    }

    fn forward(&self, points: &[f32], result: &mut [f32]) -> Result<()> {
        check_list(self.plan.shape, self.plan.rows.count, points, result.len())?;
        // SAFETY: `prepare` found the instructions; the lengths were just checked.
        SCRATCH.with_borrow_mut(|scratch| unsafe { (self.forward_list)(scratch, self, points, result) });
        Ok(())
    }
}

/// Where many threads write, each its own places.
#[derive(Clone, Copy)]
struct Shared(*mut f32);

// SAFETY: pieces of work write disjoint places, see `Piece`.
unsafe impl Send for Shared {}
// SAFETY: as above.
unsafe impl Sync for Shared {}

/// A piece of work: some points of one (image, region).
struct Piece<'a> {
    evaluation: &'a Evaluation<'a, f32>,
    plan: &'a Plan,
    packed: &'a PackedRegion,
    /// image · k + region
    pair: usize,
    points: Range<usize>,
}

impl<'a> Piece<'a> {
    fn film(&self) -> &'a [f32] {
        let len = film_len(self.plan.shape);
        &self.evaluation.film[self.pair * len..][..len]
    }

    fn weights(&self) -> &'a [f32] {
        let len = self.plan.shape.parameter_count();
        &self.evaluation.weights[self.pair % self.evaluation.extent.regions * len..][..len]
    }

    /// The tiles: the index of the first point and the points.
    fn tiles(&self) -> impl Iterator<Item = (usize, &'a [f32])> + use<'a> {
        let columns = self.plan.shape.point_columns();
        let image = self.pair / self.evaluation.extent.regions * self.evaluation.extent.points;
        let points =
            &self.evaluation.points[(image + self.points.start) * columns..(image + self.points.end) * columns];
        let first = self.points.start;
        points.chunks(TILE * columns).enumerate().map(move |(tile, points)| (first + tile * TILE, points))
    }

    /// The image's point `index`.
    fn point(&self, index: usize) -> &'a [f32] {
        let columns = self.plan.shape.point_columns();
        let image = self.pair / self.evaluation.extent.regions * self.evaluation.extent.points;
        &self.evaluation.points[(image + index) * columns..][..columns]
    }

    /// Where row `row` of the image's point `index` lies in a result.
    fn place(&self, row: usize, index: usize) -> usize {
        (self.pair * self.plan.rows.count + row) * self.evaluation.extent.points + index
    }

    /// The rows of this piece's (image, region) in a result, from point `first`.
    fn rows(&self, result: Shared, first: usize) -> ResultRows {
        let stride = self.evaluation.extent.points;
        let start = self.pair * self.plan.rows.count * stride + first;
        // SAFETY: within the result, whose length was checked.
        ResultRows { start: unsafe { result.0.add(start) }, stride, point_stride: 1 }
    }
}

/// The upstream gradient of a whole evaluation, and where it is not negligible.
#[derive(Clone, Copy)]
struct Upstream<'a> {
    values: &'a [f32],
    contribution: &'a Contribution,
}

/// One thread's memory, kept between pieces of work.
#[derive(Default)]
struct Scratch {
    folded: Aligned,
    room: Aligned,
    gradient: Aligned,
    gathered: Gathered,
}

/// Points of a piece that lie apart, brought together to fill a tile.
#[derive(Default)]
struct Gathered {
    /// Indices of the image's points whose upstream gradient counts.
    indices: Vec<u32>,
    points: Vec<f32>,
    /// `[C, TILE]`
    upstream: Vec<f32>,
    points_gradient: Vec<f32>,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// # Safety
/// The processor has V's instructions; `result` has the evaluation's length and no other piece has these points.
#[inline(always)]
unsafe fn forward_piece<V: Lanes, const ROWS: usize>(scratch: &mut Scratch, piece: &Piece<'_>, result: Shared) {
    let layout = FoldedLayout::new(piece.plan);
    scratch.room.grow(Tile::room_len(piece.plan));
    // SAFETY: the caller's promise; room and folded memory were grown to their layouts.
    unsafe {
        let reverse = !piece.plan.sweeps.is_empty();
        let bounds = fold::<V>(piece.plan, piece.packed, piece.weights(), piece.film(), &mut scratch.folded, reverse);
        let (folded, room) = (scratch.folded.as_ptr(), scratch.room.as_mut_ptr());
        let tile = Tile { plan: piece.plan, layout: &layout, folded, bounds, room };
        for (first, points) in piece.tiles() {
            tile.forward::<V, ROWS>(points, piece.rows(result, first));
        }
    }
}

/// # Safety
/// The processor has V's instructions; `result` has C values for every point.
#[inline(always)]
unsafe fn forward_list<V: Lanes, const ROWS: usize>(
    scratch: &mut Scratch,
    region: &Folded,
    points: &[f32],
    result: &mut [f32],
) {
    let plan = &region.plan;
    let columns = plan.shape.point_columns();
    let point_stride = plan.rows.count;
    scratch.room.grow(Tile::room_len(plan));
    let room = scratch.room.as_mut_ptr();
    let tile = Tile { plan, layout: &region.layout, folded: region.folded.as_ptr(), bounds: region.bounds, room };
    for (index, points) in points.chunks(TILE * columns).enumerate() {
        // SAFETY: the caller's promise; the room was grown to its layout.
        unsafe {
            let start = result.as_mut_ptr().add(index * TILE * point_stride);
            let rows = ResultRows { start, stride: 1, point_stride };
            tile.forward::<V, ROWS>(points, rows);
        }
    }
}

/// # Safety
/// As [`forward_piece`]; `points_gradient` is null or has N · columns values, at first 0, for every (image, region).
#[inline(always)]
unsafe fn backward_piece<V: Lanes, const ROWS: usize>(
    scratch: &mut Scratch,
    piece: &Piece<'_>,
    upstream: Upstream<'_>,
    partial: &mut [f32],
    points_gradient: Shared,
) {
    let plan = piece.plan;
    let (layout, gradient_layout) = (FoldedLayout::new(plan), GradientLayout::new(plan));
    let Scratch { folded, room, gradient, gathered } = scratch;
    let Gathered { indices, points, upstream: rows, points_gradient: moved } = gathered;
    upstream.contribution.list(piece.pair, piece.points.clone(), indices);
    let (columns, count) = (plan.shape.point_columns(), plan.rows.count);
    room.grow(Tile::room_len(plan));
    gradient.grow(gradient_layout.len);
    gradient.fill(0.0);
    points.resize(TILE * columns, 0.0);
    rows.resize(TILE * count, 0.0);
    moved.resize(TILE * columns, 0.0);
    let wants_points = !points_gradient.0.is_null();
    // SAFETY: the caller's promise; all scratch memory was grown to its layout. The upstream is only read.
    unsafe {
        let bounds = fold::<V>(plan, piece.packed, piece.weights(), piece.film(), folded, true);
        let tile = Tile { plan, layout: &layout, folded: folded.as_ptr(), bounds, room: room.as_mut_ptr() };
        for indices in indices.chunks(TILE) {
            for (place, index) in indices.iter().enumerate() {
                points[place * columns..][..columns].copy_from_slice(piece.point(*index as usize));
                for row in 0..count {
                    rows[row * TILE + place] = upstream.values[piece.place(row, *index as usize)];
                }
            }
            let start = ResultRows { start: rows.as_mut_ptr(), stride: TILE, point_stride: 1 };
            let target = if wants_points { moved.as_mut_ptr() } else { std::ptr::null_mut() };
            let sums = TileGradients { layout: &gradient_layout, sums: gradient.as_mut_ptr(), points: target };
            tile.backward::<V, ROWS>(&points[..indices.len() * columns], start, &sums);
            if wants_points {
                for (moved, index) in moved.chunks_exact(columns).zip(indices) {
                    let place = (piece.pair * piece.evaluation.extent.points + *index as usize) * columns;
                    std::ptr::copy_nonoverlapping(moved.as_ptr(), points_gradient.0.add(place), columns);
                }
            }
        }
        let (weights, film) = partial.split_at_mut(plan.shape.parameter_count());
        unfold::<V>(plan, piece.packed, piece.film(), gradient, weights, film);
    }
}

macro_rules! instruction_set {
    ($kernel:ident, $module:ident, $name:literal, $lanes:ty, $rows:literal, $available:expr $(, $features:literal)?) => {
        #[doc = concat!("The fused kernel `", $name, "`.")]
        pub static $kernel: Fused =
            Fused {
                name: $name,
                available: || $available,
                forward: $module::forward,
                backward: $module::backward,
                fold: $module::fold,
                forward_list: $module::forward_list,
            };

        mod $module {
            use super::{Aligned, AngleBounds, Folded, PackedRegion, Piece, Plan, Scratch, Shared, Upstream};

            /// # Safety
            /// As [`super::forward_piece`].
            $(#[target_feature(enable = $features)])?
            pub unsafe fn forward(scratch: &mut Scratch, piece: &Piece<'_>, result: Shared) {
                // SAFETY: this function's own features, the caller's promise.
                unsafe { super::forward_piece::<$lanes, $rows>(scratch, piece, result) }
            }

            /// # Safety
            /// As [`super::backward_piece`].
            $(#[target_feature(enable = $features)])?
            pub unsafe fn backward(
                scratch: &mut Scratch,
                piece: &Piece<'_>,
                upstream: Upstream<'_>,
                partial: &mut [f32],
                points: Shared,
            ) {
                // SAFETY: this function's own features, the caller's promise.
                unsafe { super::backward_piece::<$lanes, $rows>(scratch, piece, upstream, partial, points) }
            }

            /// # Safety
            /// As [`super::fold`].
            $(#[target_feature(enable = $features)])?
            pub unsafe fn fold(
                plan: &Plan,
                packed: &PackedRegion,
                weights: &[f32],
                film: &[f32],
                folded: &mut Aligned,
            ) -> AngleBounds {
                // SAFETY: this function's own features, the caller's promise.
                unsafe { super::fold::<$lanes>(plan, packed, weights, film, folded, !plan.sweeps.is_empty()) }
            }

            /// # Safety
            /// As [`super::forward_list`].
            $(#[target_feature(enable = $features)])?
            pub unsafe fn forward_list(scratch: &mut Scratch, region: &Folded, points: &[f32], result: &mut [f32]) {
                // SAFETY: this function's own features, the caller's promise.
                unsafe { super::forward_list::<$lanes, $rows>(scratch, region, points, result) }
            }
        }
    };
}

// Rows of a block of registers that is up to three vectors wide: their sums take 24 of 32 registers, 12 of 16 or, where
// a multiply-add needs one more for its product, 8.
#[cfg(target_arch = "x86_64")]
instruction_set!(
    AVX512,
    avx512,
    "avx512",
    std::arch::x86_64::__m512,
    8,
    is_x86_feature_detected!("avx512f"),
    "avx512f"
);
#[cfg(target_arch = "x86_64")]
instruction_set!(
    AVX2,
    avx2,
    "avx2",
    std::arch::x86_64::__m256,
    6,
    is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
    "avx2,fma"
);
#[cfg(target_arch = "aarch64")]
instruction_set!(
    NEON,
    neon,
    "neon",
    std::arch::aarch64::float32x4_t,
    8,
    std::arch::is_aarch64_feature_detected!("neon"),
    "neon"
);
instruction_set!(PORTABLE, portable, "portable", crate::simd::Portable, 4, true);

impl Fused {
    fn check(&self) -> Result<()> {
        if (self.available)() {
            Ok(())
        } else {
            Err(Error::config("CNERF_KERNEL", format!("this processor cannot run `{}`; leave it unset", self.name)))
        }
    }
}

impl RegionKernel<f32> for Fused {
    fn name(&self) -> &'static str {
        self.name
    }

    fn available(&self) -> bool {
        (self.available)()
    }

    fn forward(&self, evaluation: &Evaluation<'_, f32>, result: &mut [f32]) -> Result<()> {
        self.check()?;
        check_length("result", &[evaluation.result_len()], result.len())?;
        let plan = Plan::new(evaluation.shape, evaluation.outputs);
        let packed = pack(evaluation, &plan);
        let cut = Cut::new(evaluation.extent, evaluation.extent.points.div_ceil(CHUNK_POINTS));
        let shared = Shared(result.as_mut_ptr());
        (0..cut.pieces()).into_par_iter().for_each(|index| {
            let piece = cut.piece(index, evaluation, &plan, &packed);
            // SAFETY: `check` found the instructions; the pieces' points are disjoint and cover the checked result.
            SCRATCH.with_borrow_mut(|scratch| unsafe { (self.forward)(scratch, &piece, shared) });
        });
        Ok(())
    }

    fn backward(
        &self,
        evaluation: &Evaluation<'_, f32>,
        upstream: &[f32],
        gradients: Gradients<'_, f32>,
    ) -> Result<()> {
        self.check()?;
        check_length("upstream", &[evaluation.result_len()], upstream.len())?;
        gradients.check(evaluation)?;
        let Extent { images, regions, points } = evaluation.extent;
        let plan = Plan::new(evaluation.shape, evaluation.outputs);
        let packed = pack(evaluation, &plan);
        let enough = BACKWARD_PIECES.div_ceil((images * regions).max(1));
        let cut = Cut::new(evaluation.extent, points.div_ceil(CHUNK_POINTS).min(enough));
        let (parameters, film_len) = (plan.shape.parameter_count(), film_len(plan.shape));
        let partial_len = parameters + film_len;
        let contribution = Contribution::new(images * regions, plan.rows.count, points, upstream);
        let upstream = Upstream { values: upstream, contribution: &contribution };

        let image_values = points * plan.shape.point_columns();
        let mut per_region = vec![0.0; if gradients.points.is_some() { images * regions * image_values } else { 0 }];
        let shared = Shared(if gradients.points.is_some() { per_region.as_mut_ptr() } else { std::ptr::null_mut() });

        gradients.weights.fill(0.0);
        gradients.film.fill(0.0);
        let wave = (PARTIAL_VALUES / partial_len).max(BACKWARD_PIECES).min(cut.pieces().max(1));
        let mut partials = vec![0.0; wave * partial_len];
        for first in (0..cut.pieces()).step_by(wave) {
            let indices = first..cut.pieces().min(first + wave);
            let partials = &mut partials[..indices.len() * partial_len];
            partials.par_chunks_exact_mut(partial_len).zip(indices.clone()).for_each(|(partial, index)| {
                let piece = cut.piece(index, evaluation, &plan, &packed);
                // SAFETY: `check` found the instructions; lengths were checked; the pieces' points are disjoint.
                SCRATCH.with_borrow_mut(|scratch| unsafe {
                    (self.backward)(scratch, &piece, upstream, partial, shared);
                });
            });
            let pieces = || partials.chunks_exact(partial_len).zip(indices.clone());
            gradients.weights.par_chunks_exact_mut(parameters).enumerate().for_each(|(region, sum)| {
                for (partial, _) in pieces().filter(|(_, index)| cut.pair(*index) % regions == region) {
                    add(sum, &partial[..parameters]);
                }
            });
            for (partial, index) in pieces() {
                add(&mut gradients.film[cut.pair(index) * film_len..][..film_len], &partial[parameters..]);
            }
        }
        if let Some(sum) = gradients.points
            && image_values > 0
        {
            let images = per_region.par_chunks_exact(regions.max(1) * image_values);
            sum.par_chunks_exact_mut(image_values).zip(images).for_each(|(sum, image)| {
                sum.fill(0.0);
                image.chunks_exact(image_values).for_each(|region| add(sum, region));
            });
        }
        Ok(())
    }

    fn prepare(
        &self,
        shape: HeadShape,
        outputs: Outputs,
        weights: &[f32],
        film: &[f32],
    ) -> Result<Box<dyn PreparedRegion<f32>>> {
        self.check()?;
        check_region(shape, weights, film)?;
        let plan = Plan::new(shape, outputs);
        let packed = PackedRegion::new(&plan, weights);
        let mut folded = Aligned::default();
        // SAFETY: `check` found the instructions; the slices are one region's.
        let bounds = unsafe { (self.fold)(&plan, &packed, weights, film, &mut folded) };
        let layout = FoldedLayout::new(&plan);
        Ok(Box::new(Folded { plan, layout, folded, bounds, forward_list: self.forward_list }))
    }
}

fn add(sum: &mut [f32], terms: &[f32]) {
    for (sum, term) in sum.iter_mut().zip(terms) {
        *sum += term;
    }
}

fn pack(evaluation: &Evaluation<'_, f32>, plan: &Plan) -> Vec<PackedRegion> {
    let regions = evaluation.weights.par_chunks_exact(plan.shape.parameter_count());
    regions.map(|weights| PackedRegion::new(plan, weights)).collect()
}

/// How an evaluation is cut into pieces: by sizes alone.
struct Cut {
    extent: Extent,
    /// Points of every chunk but the last.
    chunk_points: usize,
    chunks: usize,
}

impl Cut {
    /// Into at most `chunks` for every (image, region).
    fn new(extent: Extent, chunks: usize) -> Self {
        let chunk_points = extent.points.div_ceil(chunks.max(1)).next_multiple_of(TILE).max(TILE);
        Self { extent, chunk_points, chunks: extent.points.div_ceil(chunk_points) }
    }

    fn pieces(&self) -> usize {
        self.extent.images * self.extent.regions * self.chunks
    }

    fn pair(&self, index: usize) -> usize {
        index / self.chunks
    }

    fn piece<'a>(
        &self,
        index: usize,
        evaluation: &'a Evaluation<'a, f32>,
        plan: &'a Plan,
        packed: &'a [PackedRegion],
    ) -> Piece<'a> {
        let pair = self.pair(index);
        let start = index % self.chunks * self.chunk_points;
        let points = start..self.extent.points.min(start + self.chunk_points);
        Piece { evaluation, plan, packed: &packed[pair % self.extent.regions], pair, points }
    }
}
