//! Every random draw of the suite. A draw is a function of a seed and a path of counters, never of how many draws
//! came before it or of the thread that made it, so the same seed gives the same bytes at any thread count and a
//! resumed run continues as if it had never stopped.

use candle_core::{Device, Tensor};
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::error::Result;

/// A seeded stream of random numbers.
#[derive(Clone, Debug)]
pub struct Stream(ChaCha8Rng);

impl Stream {
    /// The stream named by `seed` and `path`. The path says what is drawn, e.g. `[step, IMAGE_ORDER]`.
    pub fn new(seed: u64, path: &[u64]) -> Self {
        // SplitMix64 over seed and path: distinct paths give unrelated ChaCha keys.
        let mut state = seed ^ 0x9e37_79b9_7f4a_7c15;
        let mut key = [0u8; 32];
        for (index, word) in path.iter().chain(&[path.len() as u64]).enumerate() {
            state = split_mix(state ^ word.rotate_left(index as u32 % 64).wrapping_mul(0xd129_0d3d_5c7e_a3b1));
        }
        for chunk in key.chunks_exact_mut(8) {
            state = split_mix(state);
            chunk.copy_from_slice(&state.to_le_bytes());
        }
        Self(ChaCha8Rng::from_seed(key))
    }

    /// 64 random bits.
    pub fn bits(&mut self) -> u64 {
        self.0.next_u64()
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f32 {
        self.0.random::<f32>()
    }

    /// Uniform in [low, high).
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * self.uniform()
    }

    /// Uniform integer in [0, count); 0 if `count` is 0.
    pub fn below(&mut self, count: usize) -> usize {
        if count == 0 { 0 } else { self.0.random_range(0..count) }
    }

    /// Whether an event of this probability happens.
    pub fn chance(&mut self, probability: f32) -> bool {
        self.uniform() < probability
    }

    /// Standard normal, by Box-Muller in f64.
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.0.random::<f64>()).ln()).sqrt();
        let angle = std::f64::consts::TAU * self.0.random::<f64>();
        (radius * angle.cos()) as f32
    }

    /// One of `items`.
    pub fn pick<'a, T>(&mut self, items: &'a [T]) -> Option<&'a T> {
        items.get(self.below(items.len()))
    }

    /// A permutation of 0..count (Fisher-Yates).
    pub fn permutation(&mut self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        for last in (1..count).rev() {
            order.swap(last, self.below(last + 1));
        }
        order
    }

    /// A tensor of standard normals, f32.
    pub fn normal_tensor(&mut self, shape: &[usize], device: &Device) -> Result<Tensor> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| self.normal()).collect();
        Ok(Tensor::from_vec(values, shape, device)?)
    }

    /// A tensor of uniform draws in [low, high), f32.
    pub fn uniform_tensor(&mut self, shape: &[usize], low: f32, high: f32, device: &Device) -> Result<Tensor> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| self.range(low, high)).collect();
        Ok(Tensor::from_vec(values, shape, device)?)
    }
}

fn split_mix(state: u64) -> u64 {
    let mut z = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_path_gives_the_same_draws_and_others_differ() {
        let draw = |seed, path: &[u64]| Stream::new(seed, path).bits();
        assert_eq!(draw(1, &[2, 3]), draw(1, &[2, 3]));
        let draws = [draw(1, &[2, 3]), draw(1, &[3, 2]), draw(2, &[2, 3]), draw(1, &[2]), draw(1, &[2, 3, 0])];
        for (index, left) in draws.iter().enumerate() {
            assert!(draws[index + 1..].iter().all(|right| left != right));
        }
    }

    #[test]
    fn normals_have_unit_variance() {
        let mut stream = Stream::new(7, &[]);
        let draws: Vec<f64> = (0..20_000).map(|_| f64::from(stream.normal())).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / draws.len() as f64;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "{mean} {variance}");
    }
}
