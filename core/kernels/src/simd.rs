//! Vectors of f32: the dozen operations the fused kernel needs, for each instruction set, and sine and cosine on them.
//!
//! Generic code over [`Lanes`] compiles to an instruction set when it is inlined whole into a function that has
//! `#[target_feature]`; so everything here and above it is `#[inline(always)]`, epilogues are traits and arrays are filled
//! by loops: closures cannot be forced inline, and an outlined one loses the features, at a tenth of the speed.

// One contract covers every method; repeating it on each would bury the code.
#![allow(clippy::missing_safety_doc)]

/// A vector of [`Lanes::COUNT`] f32 lanes.
///
/// # Safety
/// Every method may be called only where the processor has the instructions of `Self`; pointers must be valid for
/// `COUNT` values (`COUNT` × `COUNT` where said) but need no alignment.
pub trait Lanes: Copy {
    /// Number of lanes; divides 16.
    const COUNT: usize;
    /// Whether [`Lanes::mul_add`] rounds once.
    const FUSED: bool;
    /// Vectors of columns in a product's block of registers, at most 4. With the block's rows: as many sums as there are
    /// registers for beside one row of the right operand and a factor, since one sum in memory halves the speed.
    const BLOCK_VECTORS: usize;
    /// All lanes `value`.
    unsafe fn splat(value: f32) -> Self;
    /// Lanes from memory.
    unsafe fn load(source: *const f32) -> Self;
    /// Lanes to memory.
    unsafe fn store(self, target: *mut f32);
    /// self + term.
    unsafe fn add(self, term: Self) -> Self;
    /// self − term.
    unsafe fn sub(self, term: Self) -> Self;
    /// self · factor.
    unsafe fn mul(self, factor: Self) -> Self;
    /// self · factor + term.
    unsafe fn mul_add(self, factor: Self, term: Self) -> Self;
    /// term − self · factor.
    unsafe fn neg_mul_add(self, factor: Self, term: Self) -> Self;
    /// Changes the sign of each lane whose lane in `bits`, seen as an integer, is odd.
    unsafe fn negate_where_odd(self, bits: Self) -> Self;
    /// sums[i] = Σ_j rows[i · COUNT + j] for COUNT rows.
    unsafe fn sum_rows(rows: *const f32, sums: *mut f32);
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::*;

    use super::Lanes;

    // SAFETY (all blocks of this module): the caller of every method vouches for the instructions and the pointers.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Lanes for __m512 {
        const COUNT: usize = 16;
        const FUSED: bool = true;
        const BLOCK_VECTORS: usize = 4;
        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            unsafe { _mm512_set1_ps(value) }
        }
        #[inline(always)]
        unsafe fn load(source: *const f32) -> Self {
            unsafe { _mm512_loadu_ps(source) }
        }
        #[inline(always)]
        unsafe fn store(self, target: *mut f32) {
            unsafe { _mm512_storeu_ps(target, self) }
        }
        #[inline(always)]
        unsafe fn add(self, term: Self) -> Self {
            unsafe { _mm512_add_ps(self, term) }
        }
        #[inline(always)]
        unsafe fn sub(self, term: Self) -> Self {
            unsafe { _mm512_sub_ps(self, term) }
        }
        #[inline(always)]
        unsafe fn mul(self, factor: Self) -> Self {
            unsafe { _mm512_mul_ps(self, factor) }
        }
        #[inline(always)]
        unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
            unsafe { _mm512_fmadd_ps(self, factor, term) }
        }
        #[inline(always)]
        unsafe fn neg_mul_add(self, factor: Self, term: Self) -> Self {
            unsafe { _mm512_fnmadd_ps(self, factor, term) }
        }
        #[inline(always)]
        unsafe fn negate_where_odd(self, bits: Self) -> Self {
            unsafe {
                let sign = _mm512_slli_epi32::<31>(_mm512_castps_si512(bits));
                _mm512_castsi512_ps(_mm512_xor_si512(_mm512_castps_si512(self), sign))
            }
        }
        #[inline(always)]
        unsafe fn sum_rows(rows: *const f32, sums: *mut f32) {
            unsafe {
                let low = add_quarters512(add_four512(rows), add_four512(rows.add(4 * 16)));
                let high = add_quarters512(add_four512(rows.add(8 * 16)), add_four512(rows.add(12 * 16)));
                _mm512_storeu_ps(sums, add_quarters512(low, high));
            }
        }
    }

    /// From four rows a, b, c, d of 16: partial sums (a, b, c, d) in each 128-bit quarter.
    #[inline(always)]
    #[allow(clippy::undocumented_unsafe_blocks)]
    unsafe fn add_four512(rows: *const f32) -> __m512 {
        unsafe {
            let (a, b) = (_mm512_loadu_ps(rows), _mm512_loadu_ps(rows.add(16)));
            let (c, d) = (_mm512_loadu_ps(rows.add(32)), _mm512_loadu_ps(rows.add(48)));
            let ab = _mm512_castps_pd(_mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b)));
            let cd = _mm512_castps_pd(_mm512_add_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d)));
            let (low, high) = (_mm512_unpacklo_pd(ab, cd), _mm512_unpackhi_pd(ab, cd));
            _mm512_add_ps(_mm512_castpd_ps(low), _mm512_castpd_ps(high))
        }
    }

    /// Quarters (a0 + a1, a2 + a3, b0 + b1, b2 + b3).
    #[inline(always)]
    #[allow(clippy::undocumented_unsafe_blocks)]
    unsafe fn add_quarters512(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_add_ps(_mm512_shuffle_f32x4::<0x88>(a, b), _mm512_shuffle_f32x4::<0xdd>(a, b)) }
    }

    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Lanes for __m256 {
        const COUNT: usize = 8;
        const FUSED: bool = true;
        const BLOCK_VECTORS: usize = 2;
        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            unsafe { _mm256_set1_ps(value) }
        }
        #[inline(always)]
        unsafe fn load(source: *const f32) -> Self {
            unsafe { _mm256_loadu_ps(source) }
        }
        #[inline(always)]
        unsafe fn store(self, target: *mut f32) {
            unsafe { _mm256_storeu_ps(target, self) }
        }
        #[inline(always)]
        unsafe fn add(self, term: Self) -> Self {
            unsafe { _mm256_add_ps(self, term) }
        }
        #[inline(always)]
        unsafe fn sub(self, term: Self) -> Self {
            unsafe { _mm256_sub_ps(self, term) }
        }
        #[inline(always)]
        unsafe fn mul(self, factor: Self) -> Self {
            unsafe { _mm256_mul_ps(self, factor) }
        }
        #[inline(always)]
        unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
            unsafe { _mm256_fmadd_ps(self, factor, term) }
        }
        #[inline(always)]
        unsafe fn neg_mul_add(self, factor: Self, term: Self) -> Self {
            unsafe { _mm256_fnmadd_ps(self, factor, term) }
        }
        #[inline(always)]
        unsafe fn negate_where_odd(self, bits: Self) -> Self {
            unsafe {
                let sign = _mm256_slli_epi32::<31>(_mm256_castps_si256(bits));
                _mm256_castsi256_ps(_mm256_xor_si256(_mm256_castps_si256(self), sign))
            }
        }
        #[inline(always)]
        unsafe fn sum_rows(rows: *const f32, sums: *mut f32) {
            unsafe {
                let (first, second) = (add_four256(rows), add_four256(rows.add(4 * 8)));
                let low = _mm256_permute2f128_ps::<0x20>(first, second);
                let high = _mm256_permute2f128_ps::<0x31>(first, second);
                _mm256_storeu_ps(sums, _mm256_add_ps(low, high));
            }
        }
    }

    /// From four rows a, b, c, d of 8: partial sums (a, b, c, d) in each 128-bit half.
    #[inline(always)]
    #[allow(clippy::undocumented_unsafe_blocks)]
    unsafe fn add_four256(rows: *const f32) -> __m256 {
        unsafe {
            let ab = _mm256_hadd_ps(_mm256_loadu_ps(rows), _mm256_loadu_ps(rows.add(8)));
            let cd = _mm256_hadd_ps(_mm256_loadu_ps(rows.add(16)), _mm256_loadu_ps(rows.add(24)));
            _mm256_hadd_ps(ab, cd)
        }
    }
}

#[cfg(target_arch = "aarch64")]
mod aarch64 {
    use std::arch::aarch64::*;

    use super::Lanes;

    // SAFETY (all blocks of this module): the caller of every method vouches for the instructions and the pointers.
    #[allow(clippy::undocumented_unsafe_blocks)]
    impl Lanes for float32x4_t {
        const COUNT: usize = 4;
        const FUSED: bool = true;
        const BLOCK_VECTORS: usize = 4;
        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            unsafe { vdupq_n_f32(value) }
        }
        #[inline(always)]
        unsafe fn load(source: *const f32) -> Self {
            unsafe { vld1q_f32(source) }
        }
        #[inline(always)]
        unsafe fn store(self, target: *mut f32) {
            unsafe { vst1q_f32(target, self) }
        }
        #[inline(always)]
        unsafe fn add(self, term: Self) -> Self {
            unsafe { vaddq_f32(self, term) }
        }
        #[inline(always)]
        unsafe fn sub(self, term: Self) -> Self {
            unsafe { vsubq_f32(self, term) }
        }
        #[inline(always)]
        unsafe fn mul(self, factor: Self) -> Self {
            unsafe { vmulq_f32(self, factor) }
        }
        #[inline(always)]
        unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
            unsafe { vfmaq_f32(term, self, factor) }
        }
        #[inline(always)]
        unsafe fn neg_mul_add(self, factor: Self, term: Self) -> Self {
            unsafe { vfmsq_f32(term, self, factor) }
        }
        #[inline(always)]
        unsafe fn negate_where_odd(self, bits: Self) -> Self {
            unsafe {
                let sign = vshlq_n_u32::<31>(vreinterpretq_u32_f32(bits));
                vreinterpretq_f32_u32(veorq_u32(vreinterpretq_u32_f32(self), sign))
            }
        }
        #[inline(always)]
        unsafe fn sum_rows(rows: *const f32, sums: *mut f32) {
            unsafe {
                let first = vpaddq_f32(vld1q_f32(rows), vld1q_f32(rows.add(4)));
                let second = vpaddq_f32(vld1q_f32(rows.add(8)), vld1q_f32(rows.add(12)));
                vst1q_f32(sums, vpaddq_f32(first, second));
            }
        }
    }
}

/// Four lanes in plain Rust, which compilers turn into SSE2, NEON or WebAssembly vectors.
#[derive(Clone, Copy)]
#[repr(align(16))]
pub struct Portable([f32; 4]);

impl Portable {
    #[inline(always)]
    fn zip(self, other: Self, combine: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|lane| combine(self.0[lane], other.0[lane])))
    }
}

impl Lanes for Portable {
    const COUNT: usize = 4;
    // Without the instruction, `f32::mul_add` is a slow library call.
    const FUSED: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));
    const BLOCK_VECTORS: usize = 2;
    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Self([value; 4])
    }
    #[inline(always)]
    unsafe fn load(source: *const f32) -> Self {
        // SAFETY: the caller vouches for COUNT readable values.
        Self(unsafe { source.cast::<[f32; 4]>().read_unaligned() })
    }
    #[inline(always)]
    unsafe fn store(self, target: *mut f32) {
        // SAFETY: the caller vouches for COUNT writable values.
        unsafe { target.cast::<[f32; 4]>().write_unaligned(self.0) }
    }
    #[inline(always)]
    unsafe fn add(self, term: Self) -> Self {
        self.zip(term, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn sub(self, term: Self) -> Self {
        self.zip(term, |a, b| a - b)
    }
    #[inline(always)]
    unsafe fn mul(self, factor: Self) -> Self {
        self.zip(factor, |a, b| a * b)
    }
    #[inline(always)]
    unsafe fn mul_add(self, factor: Self, term: Self) -> Self {
        if Self::FUSED {
            Self(std::array::from_fn(|lane| self.0[lane].mul_add(factor.0[lane], term.0[lane])))
        } else {
            Self(std::array::from_fn(|lane| self.0[lane] * factor.0[lane] + term.0[lane]))
        }
    }
    #[inline(always)]
    unsafe fn neg_mul_add(self, factor: Self, term: Self) -> Self {
        // SAFETY: no instructions or pointers are involved.
        unsafe { Self(self.0.map(|lane| -lane)).mul_add(factor, term) }
    }
    #[inline(always)]
    unsafe fn negate_where_odd(self, bits: Self) -> Self {
        self.zip(bits, |value, bits| f32::from_bits(value.to_bits() ^ (bits.to_bits() << 31)))
    }
    #[inline(always)]
    unsafe fn sum_rows(rows: *const f32, sums: *mut f32) {
        // SAFETY: the caller vouches for COUNT x COUNT readable and COUNT writable values.
        unsafe {
            let rows: [Self; 4] = std::array::from_fn(|row| Self::load(rows.add(4 * row)));
            let sum = |row: Self| (row.0[0] + row.0[2]) + (row.0[1] + row.0[3]);
            Self(rows.map(sum)).store(sums);
        }
    }
}

/// Largest |angle| for which [`sin`] and [`cos`] are accurate: the multiple of π must have at most 12 bits.
pub const LARGEST_ANGLE: f32 = 1e4;

/// 1.5 · 2²³: adding it rounds to an integer, which is then in the low bits of the mantissa.
const ROUND: f32 = 12_582_912.0;
/// Minimax polynomial of (sin r / r − 1) / r² in r² on [−π/2, π/2]; relative error 6.1e-9.
const SINE: [f32; 4] = [-0.166_666_6, 0.008_333_066_5, -0.000_198_096_02, 2.605_780_5e-6];

/// sin(x), |error| ≤ 2e-7 for |x| ≤ [`LARGEST_ANGLE`].
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
pub unsafe fn sin<V: Lanes>(x: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        let rounded = x.mul_add(V::splat(std::f32::consts::FRAC_1_PI), V::splat(ROUND));
        let remainder = subtract_pi_multiple(x, rounded.sub(V::splat(ROUND)));
        half_wave(remainder).negate_where_odd(rounded)
    }
}

/// cos(x), |error| ≤ 2e-7 for |x| ≤ [`LARGEST_ANGLE`].
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
pub unsafe fn cos<V: Lanes>(x: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        // With x = (n + 1/2) π + r, cos x = −sin r for even n and sin r for odd n.
        let rounded = x.mul_add(V::splat(std::f32::consts::FRAC_1_PI), V::splat(-0.5)).add(V::splat(ROUND));
        let multiple = rounded.sub(V::splat(ROUND)).add(V::splat(0.5));
        let remainder = subtract_pi_multiple(x, multiple);
        half_wave(V::splat(0.0).sub(remainder)).negate_where_odd(rounded)
    }
}

/// x − multiple · π, in parts whose products are exact (Cody and Waite).
#[inline(always)]
unsafe fn subtract_pi_multiple<V: Lanes>(x: V, multiple: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        if V::FUSED {
            let remainder = multiple.neg_mul_add(V::splat(std::f32::consts::PI), x);
            // π − π rounded to f32
            multiple.neg_mul_add(V::splat(-8.742_278e-8), remainder)
        } else {
            // 11 bits each (half multiples have one more): products with 12-bit multiples are exact in f32.
            let mut remainder = x;
            for part in PI_PARTS {
                remainder = multiple.neg_mul_add(V::splat(part), remainder);
            }
            remainder
        }
    }
}

/// π in parts of 11 bits and a rest.
const PI_PARTS: [f32; 4] = [3.140_625, 0.000_967_502_6, 1.509_906_7e-7, 5.126_688e-12];

/// sin(r) for |r| ≤ π/2.
#[inline(always)]
unsafe fn half_wave<V: Lanes>(r: V) -> V {
    // SAFETY: the caller's promise.
    unsafe {
        let square = r.mul(r);
        let tail = V::splat(SINE[3]).mul_add(square, V::splat(SINE[2]));
        let tail = tail.mul_add(square, V::splat(SINE[1]));
        let tail = tail.mul_add(square, V::splat(SINE[0]));
        square.mul(r).mul_add(tail, r)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[inline(always)]
    unsafe fn check<V: Lanes>(angles: &[f32]) {
        for chunk in angles.chunks_exact(V::COUNT) {
            let (mut sine, mut cosine) = ([0f32; 16], [0f32; 16]);
            // SAFETY: the caller checked the processor; arrays hold 16 >= COUNT values.
            unsafe {
                let x = V::load(chunk.as_ptr());
                sin(x).store(sine.as_mut_ptr());
                cos(x).store(cosine.as_mut_ptr());
            }
            for (lane, &x) in chunk.iter().enumerate() {
                let x = f64::from(x);
                assert!((f64::from(sine[lane]) - x.sin()).abs() <= 2e-7, "sin {x} = {}", sine[lane]);
                assert!((f64::from(cosine[lane]) - x.cos()).abs() <= 2e-7, "cos {x} = {}", cosine[lane]);
            }
        }
        let rows: Vec<f32> = (0..V::COUNT * V::COUNT).map(|index| (index * index) as f32).collect();
        let mut sums = [0f32; 16];
        // SAFETY: as above; `rows` holds COUNT x COUNT values.
        unsafe { V::sum_rows(rows.as_ptr(), sums.as_mut_ptr()) };
        for (row, &sum) in rows.chunks_exact(V::COUNT).zip(&sums) {
            assert_eq!(row.iter().sum::<f32>(), sum);
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx512f")]
    unsafe fn check_avx512(angles: &[f32]) {
        // SAFETY: this function's own features.
        unsafe { check::<std::arch::x86_64::__m512>(angles) }
    }

    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2,fma")]
    unsafe fn check_avx2(angles: &[f32]) {
        // SAFETY: this function's own features.
        unsafe { check::<std::arch::x86_64::__m256>(angles) }
    }

    #[cfg(target_arch = "aarch64")]
    #[target_feature(enable = "neon")]
    unsafe fn check_neon(angles: &[f32]) {
        // SAFETY: this function's own features.
        unsafe { check::<std::arch::aarch64::float32x4_t>(angles) }
    }

    /// Every power-of-two scale up to the largest angle, the neighbourhoods of multiples of π/2, and an even sweep.
    fn angles() -> Vec<f32> {
        let mut angles = vec![0.0, -0.0, 1e-30, 1.0];
        for multiple in -6366..=6366 {
            let near = (f64::from(multiple) * std::f64::consts::FRAC_PI_2) as f32;
            angles.extend([near.next_down(), near, near.next_up()]);
        }
        let mut x = 1e-6f32;
        while x < LARGEST_ANGLE {
            angles.extend([x, -x]);
            x *= 1.000_05;
        }
        angles.extend((-200_000..=200_000).map(|step| step as f32 * (LARGEST_ANGLE / 200_000.0)));
        angles.resize(angles.len().next_multiple_of(16), 0.0);
        angles
    }

    #[test]
    fn sine_and_cosine_are_within_two_ten_millionths() {
        let angles = angles();
        // SAFETY: plain Rust needs no special instructions.
        unsafe { check::<Portable>(&angles) };
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: just detected.
                unsafe { check_avx512(&angles) };
            }
            if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
                // SAFETY: just detected.
                unsafe { check_avx2(&angles) };
            }
        }
        #[cfg(target_arch = "aarch64")]
        if std::arch::is_aarch64_feature_detected!("neon") {
            // SAFETY: just detected.
            unsafe { check_neon(&angles) };
        }
    }
}
