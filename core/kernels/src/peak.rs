//! What the processor could do at most: fused multiply-adds on registers alone, the ceiling a kernel is measured by.

use std::time::{Duration, Instant};

use crate::simd::{Lanes, Portable};

/// Independent chains of multiply-adds: more than latency × units of any processor so far, fewer than registers.
const CHAINS: usize = 12;
/// Multiply-adds of every chain between two looks at the clock.
const ROUNDS: usize = 1 << 14;

/// The ceiling of one instruction set.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Peak {
    /// The name of the kernels that are compiled for it.
    pub name: &'static str,
    /// Values in a register.
    pub lanes: usize,
    /// 10⁹ floating-point operations a second with all threads of the current pool at once, each in its best stretch (a
    /// ceiling is what nothing else on the machine disturbs); a multiply-add counts two.
    pub gflops: f64,
}

/// One stretch of work; returns a value that depends on all of it.
type Stretch = unsafe fn(f32) -> f32;

/// # Safety
/// The processor has V's instructions.
#[inline(always)]
unsafe fn stretch<V: Lanes>(start: f32) -> f32 {
    // SAFETY: the caller's promise; the array holds 16 ≥ COUNT values.
    unsafe {
        // Converges to 1 from any start: no chain ever slows down on denormals or infinities.
        let (factor, term) = (V::splat(0.5), V::splat(0.5));
        let mut chains = [V::splat(start); CHAINS];
        for _ in 0..ROUNDS {
            for chain in &mut chains {
                *chain = chain.mul_add(factor, term);
            }
        }
        let mut sum = chains[0];
        for chain in &chains[1..] {
            sum = sum.add(*chain);
        }
        let mut lanes = [0f32; 16];
        sum.store(lanes.as_mut_ptr());
        lanes.iter().sum()
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::{__m256, __m512};

    /// # Safety
    /// The processor has AVX-512F.
    #[target_feature(enable = "avx512f")]
    pub unsafe fn avx512(start: f32) -> f32 {
        // SAFETY: this function's own features.
        unsafe { super::stretch::<__m512>(start) }
    }

    /// # Safety
    /// The processor has AVX2 and FMA.
    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn avx2(start: f32) -> f32 {
        // SAFETY: this function's own features.
        unsafe { super::stretch::<__m256>(start) }
    }
}

/// # Safety
/// The processor has NEON.
#[cfg(target_arch = "aarch64")]
#[target_feature(enable = "neon")]
unsafe fn neon(start: f32) -> f32 {
    // SAFETY: this function's own features.
    unsafe { stretch::<std::arch::aarch64::float32x4_t>(start) }
}

/// # Safety
/// None is needed: plain Rust.
unsafe fn portable(start: f32) -> f32 {
    // SAFETY: no instructions beyond the baseline.
    unsafe { stretch::<Portable>(start) }
}

/// Measures every instruction set of this processor for `duration` each, the widest first.
pub fn measure(duration: Duration) -> Vec<Peak> {
    let mut sets: Vec<(&'static str, usize, Stretch)> = Vec::new();
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            sets.push(("avx512", <std::arch::x86_64::__m512 as Lanes>::COUNT, x86::avx512));
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            sets.push(("avx2", <std::arch::x86_64::__m256 as Lanes>::COUNT, x86::avx2));
        }
    }
    #[cfg(target_arch = "aarch64")]
    if std::arch::is_aarch64_feature_detected!("neon") {
        sets.push(("neon", <std::arch::aarch64::float32x4_t as Lanes>::COUNT, neon));
    }
    sets.push(("portable", Portable::COUNT, portable));
    sets.into_iter().map(|(name, lanes, run)| Peak { name, lanes, gflops: gflops(run, lanes, duration) }).collect()
}

/// The sum over the pool's threads of the fastest stretch of each while all were busy.
fn gflops(run: Stretch, lanes: usize, duration: Duration) -> f64 {
    let operations = (2 * lanes * CHAINS * ROUNDS) as f64;
    let rates = rayon::broadcast(|_| {
        // SAFETY: `measure` lists only what the processor has.
        let work = || std::hint::black_box(unsafe { run(std::hint::black_box(0.0)) });
        // Wide registers wake slowly: a tenth of the time goes to that.
        let warm = Instant::now();
        while warm.elapsed() < duration / 10 {
            work();
        }
        let (began, mut shortest) = (Instant::now(), f64::INFINITY);
        while began.elapsed() < duration {
            let stretch = Instant::now();
            work();
            shortest = shortest.min(stretch.elapsed().as_secs_f64());
        }
        operations / shortest
    });
    rates.iter().sum::<f64>() / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_instruction_set_has_a_ceiling() {
        let peaks = measure(Duration::from_millis(20));
        assert_eq!(peaks.last().map(|peak| peak.name), Some("portable"));
        for peak in peaks {
            // Emulators have a ceiling too, a low one.
            assert!(peak.gflops > 1e-3 && peak.gflops.is_finite(), "{peak:?}");
        }
    }

    #[test]
    fn a_stretch_converges_to_one_in_every_lane() {
        // SAFETY: plain Rust.
        assert_eq!(unsafe { portable(7.0) }, (CHAINS * Portable::COUNT) as f32);
    }
}
