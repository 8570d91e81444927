//! The inner product under every convolution: a few rows of one operand, a few vectors of the other, all sums in
//! registers. Written once over [`Lanes`] and compiled for each instruction set that [`on`] can choose.

use super::InstructionSet;
use crate::simd::{Lanes, Portable};

/// Most rows that one product holds in registers.
pub(super) const MOST_ROWS: usize = 8;

/// Side of the squares that [`transpose`] moves at a time.
const SQUARE: usize = 8;

/// What the products need of a register type beyond its lanes.
///
/// # Safety
/// As [`Lanes`].
pub(super) trait Registers: Lanes {
    /// Rows of a full product.
    const ROWS: usize;
    /// Vectors of a full product: with the rows, as many sums as leave the register file room for the operands. (Filled
    /// to the last register, compilers shuffle sums about at a third of the speed.)
    const VECTORS: usize;

    /// Transposes 8 × 8 values: `to[i·to_stride + j] = from[j·from_stride + i]`.
    ///
    /// # Safety
    /// The processor has this type's instructions; both squares are inside their buffers and apart.
    #[inline(always)]
    unsafe fn transpose_square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
        for i in 0..SQUARE {
            for j in 0..SQUARE {
                // SAFETY: the caller vouches for both squares.
                unsafe { *to.add(i * to_stride + j) = *from.add(j * from_stride + i) };
            }
        }
    }
}

impl Registers for Portable {
    const ROWS: usize = 4;
    const VECTORS: usize = 2;
}

#[cfg(target_arch = "aarch64")]
impl Registers for std::arch::aarch64::float32x4_t {
    const ROWS: usize = 8;
    const VECTORS: usize = 3;
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    impl super::Registers for __m512 {
        const ROWS: usize = 8;
        const VECTORS: usize = 3;

        #[inline(always)]
        unsafe fn transpose_square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
            // SAFETY: the caller vouches for both squares and for AVX-512F, which no processor has without AVX.
            unsafe { transpose_square(from, from_stride, to, to_stride) }
        }
    }

    impl super::Registers for __m256 {
        const ROWS: usize = 6;
        const VECTORS: usize = 2;

        #[inline(always)]
        unsafe fn transpose_square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
            // SAFETY: the caller vouches for both squares and for AVX.
            unsafe { transpose_square(from, from_stride, to, to_stride) }
        }
    }

    /// Pairs, then quadruples, then halves of the rows change places.
    #[inline(always)]
    unsafe fn transpose_square(from: *const f32, from_stride: usize, to: *mut f32, to_stride: usize) {
        // SAFETY: the caller vouches for AVX and for both squares.
        unsafe {
            let (r0, r1, r2, r3) = (
                _mm256_loadu_ps(from),
                _mm256_loadu_ps(from.add(from_stride)),
                _mm256_loadu_ps(from.add(2 * from_stride)),
                _mm256_loadu_ps(from.add(3 * from_stride)),
            );
            let (r4, r5, r6, r7) = (
                _mm256_loadu_ps(from.add(4 * from_stride)),
                _mm256_loadu_ps(from.add(5 * from_stride)),
                _mm256_loadu_ps(from.add(6 * from_stride)),
                _mm256_loadu_ps(from.add(7 * from_stride)),
            );
            let (a0, a1) = (_mm256_unpacklo_ps(r0, r1), _mm256_unpackhi_ps(r0, r1));
            let (a2, a3) = (_mm256_unpacklo_ps(r2, r3), _mm256_unpackhi_ps(r2, r3));
            let (a4, a5) = (_mm256_unpacklo_ps(r4, r5), _mm256_unpackhi_ps(r4, r5));
            let (a6, a7) = (_mm256_unpacklo_ps(r6, r7), _mm256_unpackhi_ps(r6, r7));
            let (b0, b1) = (_mm256_shuffle_ps::<0x44>(a0, a2), _mm256_shuffle_ps::<0xee>(a0, a2));
            let (b2, b3) = (_mm256_shuffle_ps::<0x44>(a1, a3), _mm256_shuffle_ps::<0xee>(a1, a3));
            let (b4, b5) = (_mm256_shuffle_ps::<0x44>(a4, a6), _mm256_shuffle_ps::<0xee>(a4, a6));
            let (b6, b7) = (_mm256_shuffle_ps::<0x44>(a5, a7), _mm256_shuffle_ps::<0xee>(a5, a7));
            _mm256_storeu_ps(to, _mm256_permute2f128_ps::<0x20>(b0, b4));
            _mm256_storeu_ps(to.add(to_stride), _mm256_permute2f128_ps::<0x20>(b1, b5));
            _mm256_storeu_ps(to.add(2 * to_stride), _mm256_permute2f128_ps::<0x20>(b2, b6));
            _mm256_storeu_ps(to.add(3 * to_stride), _mm256_permute2f128_ps::<0x20>(b3, b7));
            _mm256_storeu_ps(to.add(4 * to_stride), _mm256_permute2f128_ps::<0x31>(b0, b4));
            _mm256_storeu_ps(to.add(5 * to_stride), _mm256_permute2f128_ps::<0x31>(b1, b5));
            _mm256_storeu_ps(to.add(6 * to_stride), _mm256_permute2f128_ps::<0x31>(b2, b6));
            _mm256_storeu_ps(to.add(7 * to_stride), _mm256_permute2f128_ps::<0x31>(b3, b7));
        }
    }
}

/// Transposes a matrix: `to[i·to_stride + j] = from[j·from_stride + i]` for j < `rows`, i < `columns`.
///
/// # Safety
/// The processor has `V`'s instruction set; both matrices are inside their buffers and apart.
#[inline(always)]
pub(super) unsafe fn transpose<V: Registers>(
    (rows, columns): (usize, usize),
    (from, from_stride): (*const f32, usize),
    (to, to_stride): (*mut f32, usize),
) {
    // SAFETY: the caller vouches for the whole matrices, and every index below is inside them.
    unsafe {
        for j in (0..rows).step_by(SQUARE) {
            for i in (0..columns).step_by(SQUARE) {
                let (from, to) = (from.add(j * from_stride + i), to.add(i * to_stride + j));
                if j + SQUARE <= rows && i + SQUARE <= columns {
                    V::transpose_square(from, from_stride, to, to_stride);
                    continue;
                }
                for i in 0..SQUARE.min(columns - i) {
                    for j in 0..SQUARE.min(rows - j) {
                        *to.add(i * to_stride + j) = *from.add(j * from_stride + i);
                    }
                }
            }
        }
    }
}

/// Work to be compiled once for each instruction set. Implementations must be `inline(always)`, and must not call
/// closures: neither a plain call nor a closure inherits the instruction set.
pub(super) trait Job {
    /// Does the work with registers of type `V`.
    ///
    /// # Safety
    /// The processor has `V`'s instruction set.
    unsafe fn run<V: Registers>(self);
}

/// Runs `job` with the registers of `instruction_set`, which must be one this processor has
/// ([`InstructionSet::available`]); anything else falls back to [`Portable`].
pub(super) fn on<J: Job>(instruction_set: InstructionSet, job: J) {
    match instruction_set {
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx512 if InstructionSet::Avx512.available() => {
            // SAFETY: the processor was just asked.
            unsafe { with_avx512(job) }
        }
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx2 if InstructionSet::Avx2.available() => {
            // SAFETY: the processor was just asked.
            unsafe { with_avx2(job) }
        }
        #[cfg(target_arch = "aarch64")]
        InstructionSet::Neon if InstructionSet::Neon.available() => {
            // SAFETY: the processor was just asked.
            unsafe { with_neon(job) }
        }
        // SAFETY: plain Rust, no instruction set needed.
        _ => unsafe { job.run::<Portable>() },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
fn with_avx512<J: Job>(job: J) {
    // SAFETY: this function can only be reached on processors with AVX-512F.
    unsafe { job.run::<std::arch::x86_64::__m512>() }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn with_avx2<J: Job>(job: J) {
    // SAFETY: this function can only be reached on processors with AVX2 and FMA.
    unsafe { job.run::<std::arch::x86_64::__m256>() }
}

#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
fn with_neon<J: Job>(job: J) {
    // SAFETY: this function can only be reached on processors with NEON.
    unsafe { job.run::<std::arch::aarch64::float32x4_t>() }
}

/// One small product: `out[m][n] = initial[m] + Σ_r Σ_k rows[m][r·row_step + k] · columns[r·column_step + offsets[k] + n]`.
pub(super) struct Product<'a> {
    /// Where each row starts.
    pub rows: [*const f32; MOST_ROWS],
    /// How far every row moves from one repetition to the next.
    pub row_step: usize,
    /// Where the vectors start.
    pub columns: *const f32,
    /// How far the vectors move from one repetition to the next.
    pub column_step: usize,
    /// Where the vectors of each summand are, from `columns` on.
    pub offsets: &'a [u32],
    /// Number of repetitions (the sum over r).
    pub repetitions: usize,
    /// Row-major sums, `out_stride` values from row to row.
    pub out: *mut f32,
    /// Distance of two rows of `out`.
    pub out_stride: usize,
    /// Rows to be stored; the others only fill up the registers.
    pub stored: usize,
    /// What the sums of each row start from; none where `out` holds earlier summands to add to.
    pub initial: Option<[f32; MOST_ROWS]>,
}

/// The height of the product that treats `left` remaining rows: a full one while there are enough.
/// Surplus rows of a product must point at readable values; their sums are computed and ignored.
#[inline(always)]
pub(super) fn rows_of_next<V: Registers>(left: usize) -> usize {
    match left {
        1 => 1,
        2..=4 => 4,
        _ => V::ROWS,
    }
}

/// Computes `product` for `rows` rows (from [`rows_of_next`]) and `vectors` vectors (1 to [`Registers::VECTORS`]).
///
/// # Safety
/// The processor has `V`'s instruction set; every address that the formula of [`Product`] names is readable, and
/// `out` is writable, for `rows` rows and `vectors · COUNT` columns.
#[inline(always)]
pub(super) unsafe fn multiply<V: Registers>(rows: usize, vectors: usize, product: &Product<'_>) {
    // SAFETY: the caller's promise covers every shape up to (rows, vectors), and each arm computes exactly that one.
    unsafe {
        match (rows, vectors) {
            (8, 3) if V::ROWS == 8 => tile::<V, 8, 3>(product),
            (8, 2) if V::ROWS == 8 => tile::<V, 8, 2>(product),
            (8, _) if V::ROWS == 8 => tile::<V, 8, 1>(product),
            (6, 2) if V::ROWS == 6 => tile::<V, 6, 2>(product),
            (6, _) if V::ROWS == 6 => tile::<V, 6, 1>(product),
            (4, 3) if V::VECTORS == 3 => tile::<V, 4, 3>(product),
            (4, 2) => tile::<V, 4, 2>(product),
            (4, _) => tile::<V, 4, 1>(product),
            (_, 3) if V::VECTORS == 3 => tile::<V, 1, 3>(product),
            (_, 2) => tile::<V, 1, 2>(product),
            (_, _) => tile::<V, 1, 1>(product),
        }
    }
}

/// [`multiply`] at a fixed shape, all sums in registers.
#[inline(always)]
unsafe fn tile<V: Registers, const ROWS: usize, const VECTORS: usize>(product: &Product<'_>) {
    // SAFETY: the caller of `multiply` vouches for every address below.
    unsafe {
        let mut sums = [[V::splat(0.0); VECTORS]; ROWS];
        for (m, row) in sums.iter_mut().enumerate() {
            for (n, sum) in row.iter_mut().enumerate() {
                match product.initial {
                    Some(initial) => *sum = V::splat(initial[m]),
                    None if m < product.stored => {
                        *sum = V::load(product.out.add(m * product.out_stride + n * V::COUNT));
                    }
                    None => {}
                }
            }
        }
        for repetition in 0..product.repetitions {
            let columns = product.columns.add(repetition * product.column_step);
            let mut rows = [product.rows[0]; ROWS];
            for (row, start) in rows.iter_mut().zip(product.rows) {
                *row = start.add(repetition * product.row_step);
            }
            for (k, &offset) in product.offsets.iter().enumerate() {
                let from = columns.add(offset as usize);
                let mut factors = [V::splat(0.0); VECTORS];
                for (n, factor) in factors.iter_mut().enumerate() {
                    *factor = V::load(from.add(n * V::COUNT));
                }
                for (row, sums) in rows.iter().zip(sums.iter_mut()) {
                    let weight = V::splat(*row.add(k));
                    for (sum, factor) in sums.iter_mut().zip(factors) {
                        *sum = weight.mul_add(factor, *sum);
                    }
                }
            }
        }
        for (m, row) in sums.iter().enumerate() {
            if m >= product.stored {
                break;
            }
            for (n, sum) in row.iter().enumerate() {
                sum.store(product.out.add(m * product.out_stride + n * V::COUNT));
            }
        }
    }
}
