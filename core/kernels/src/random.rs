//! Seeded draws for the tests.

use candle_core::{Device, Tensor};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use crate::Result;

/// A seeded stream of random numbers.
pub struct Stream(ChaCha8Rng);

impl Stream {
    /// The stream named by `seed` and `path`.
    pub fn new(seed: u64, path: &[u64]) -> Self {
        let word = path.iter().fold(seed, |state, word| state.wrapping_mul(0x9e37_79b9_7f4a_7c15).wrapping_add(*word));
        Self(ChaCha8Rng::seed_from_u64(word))
    }

    /// Uniform integer in [0, count).
    pub fn below(&mut self, count: usize) -> usize {
        self.0.random_range(0..count)
    }

    /// One of `choices`; none if there are none.
    pub fn pick<'a, T>(&mut self, choices: &'a [T]) -> Option<&'a T> {
        if choices.is_empty() { None } else { choices.get(self.below(choices.len())) }
    }

    /// Standard normal, by Box-Muller in f64.
    pub fn normal(&mut self) -> f32 {
        let radius = (-2.0 * (1.0 - self.0.random::<f64>()).ln()).sqrt();
        (radius * (std::f64::consts::TAU * self.0.random::<f64>()).cos()) as f32
    }

    /// A tensor of standard normals, f32.
    pub fn normal_tensor(&mut self, shape: &[usize], device: &Device) -> Result<Tensor> {
        let values: Vec<f32> = (0..shape.iter().product()).map(|_| self.normal()).collect();
        Ok(Tensor::from_vec(values, shape, device)?)
    }
}
