//! How a classifier is shown pictures: shifted by a few pixels and enlarged by a random factor.
//!
//! At one fixed scale AlexNet's stride of 4 cannot tell hair from hatching of that period, and the upsampler learns to
//! hatch.

use candle_core::{Device, Tensor};

use crate::{error::Result, rng::Stream};

/// Pictures are shifted by up to this, pixels: AlexNet's stride of 4 with crops on even offsets draws stripes.
const LARGEST_SHIFT: usize = 3;

/// One such view, the same for all pictures it is shown.
pub(super) struct Zoom {
    left: usize,
    top: usize,
    side: usize,
    /// `[target, side]`.
    enlargement: Tensor,
}

impl Zoom {
    /// A random view of pictures of `side` pixels, enlarged by 1 to `largest`.
    pub fn random(side: usize, largest: f64, random: &mut Stream, device: &Device) -> Result<Self> {
        let [left, top] = [random.below(LARGEST_SHIFT + 1), random.below(LARGEST_SHIFT + 1)];
        let side = side - LARGEST_SHIFT;
        let factor = f64::from(random.range(1.0, largest as f32));
        let enlargement = enlargement(side, (side as f64 * factor).round() as usize, device)?;
        Ok(Self { left, top, side, enlargement })
    }

    /// The view of pictures `[B, 3, H, W]`.
    pub fn of(&self, pictures: &Tensor) -> Result<Tensor> {
        let crop = pictures.narrow(2, self.top, self.side)?.narrow(3, self.left, self.side)?.contiguous()?;
        Ok(self.enlargement.broadcast_matmul(&crop)?.broadcast_matmul(&self.enlargement.t()?)?)
    }
}

/// Bilinear enlargement of a line of `source` pixels to `target` as a matrix `[target, source]`, pixel centres aligned
/// as areas are, edges repeated: a product, so that candle differentiates it.
fn enlargement(source: usize, target: usize, device: &Device) -> Result<Tensor> {
    let mut weights = vec![0f32; target * source];
    for (row, weights) in weights.chunks_exact_mut(source.max(1)).enumerate() {
        let position = (row as f64 + 0.5) * source as f64 / target as f64 - 0.5;
        let position = position.clamp(0.0, (source - 1) as f64);
        let (left, share) = (position as usize, position.fract() as f32);
        weights[left] += 1.0 - share;
        weights[(left + 1).min(source - 1)] += share;
    }
    Ok(Tensor::from_vec(weights, (target, source), device)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlargement_keeps_ramps_and_is_the_identity_at_one() {
        let ramp = Tensor::arange(0f32, 8.0, &Device::Cpu).unwrap().reshape((8, 1)).unwrap();
        let at = |target| enlargement(8, target, &Device::Cpu).unwrap().matmul(&ramp).unwrap();
        let values = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(at(8)), values(ramp.clone()));
        // Between the outer pixels' centres a ramp stays one: value (row + 1/2) · 8/13 − 1/2.
        for (row, value) in values(at(13)).into_iter().enumerate() {
            let expected = ((row as f32 + 0.5) * 8.0 / 13.0 - 0.5).clamp(0.0, 7.0);
            assert!((value - expected).abs() < 1e-5, "{row}: {value}, {expected}");
        }
    }
}
