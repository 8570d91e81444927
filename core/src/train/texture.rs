//! Texture: how features vary together within small tiles, whatever lies where.
//!
//! Two pictures of the same hair are equally hairy though no strand falls on another; pixel and LPIPS losses then prefer
//! the blur between them. Covariances of features by tile (Gatys et al., 2015; by tile as in EnhanceNet, Sajjadi et al.,
//! 2017) ask for as much variation of the same kind instead. A discriminator asks for the same, but must first be trained.

use candle_core::Tensor;

use crate::error::{Error, Result};

/// Side of a tile, features.
const TILE: usize = 8;
/// Variation far below a picture's own is rounding and sensor noise, and not worth imitating.
const FLOOR: f64 = 0.05;

/// How different the textures of two pictures are by their feature maps `[B, C, h, w]`: mean over tiles of
/// |A − B|² / (|A|² + |B|²) of the covariances A and B over a tile's 8 × 8 features. 0 for the same textures, 1 where one
/// has none. Rows and columns beyond whole tiles are left out.
///
/// # Errors
/// [`Error::Shape`] for maps of different sizes, or smaller than a tile.
pub fn texture(found: &Tensor, expected: &Tensor) -> Result<Tensor> {
    if found.dims() != expected.dims() {
        return Err(Error::shape("feature maps of a texture loss", expected.dims(), found.dims()));
    }
    let (found, expected) = (covariances(found)?, covariances(expected)?);
    let size = |covariances: &Tensor| covariances.sqr()?.sum((2, 3));
    let sizes = (size(&found)? + size(&expected)?)?;
    let floor = (size(&expected)?.mean_keepdim(1)?.detach() * FLOOR)?;
    let difference = size(&(found - expected)?)?;
    Ok(difference.div(&(sizes.broadcast_add(&floor)? + f64::from(f32::MIN_POSITIVE))?)?.mean_all()?)
}

/// Covariances of the channels over each tile, `[B, tiles, C, C]`.
fn covariances(features: &Tensor) -> Result<Tensor> {
    let (batch, channels, height, width) = features.dims4()?;
    let (rows, columns) = (height / TILE, width / TILE);
    if rows == 0 || columns == 0 {
        return Err(Error::shape("feature maps of a texture loss", format!("at least {TILE} a side"), features.dims()));
    }
    let tiles = features.narrow(2, 0, rows * TILE)?.narrow(3, 0, columns * TILE)?;
    let tiles = tiles.reshape(&[batch, channels, rows, TILE, columns, TILE][..])?;
    let tiles = tiles.permute(vec![0, 2, 4, 1, 3, 5])?.contiguous()?;
    let tiles = tiles.reshape((batch, rows * columns, channels, TILE * TILE))?;
    let centred = tiles.broadcast_sub(&tiles.mean_keepdim(3)?)?;
    Ok((centred.matmul(&centred.transpose(2, 3)?.contiguous()?)? / (TILE * TILE) as f64)?)
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device, Var};

    use super::*;
    use crate::rng::Stream;

    fn noise(seed: u64, deviation: f64) -> Tensor {
        let noise = Stream::new(seed, &[]).normal_tensor(&[2, 3, 19, 16], &Device::Cpu).unwrap();
        (noise.to_dtype(DType::F64).unwrap() * deviation).unwrap()
    }

    fn value(found: &Tensor, expected: &Tensor) -> f64 {
        texture(found, expected).unwrap().to_scalar().unwrap()
    }

    #[test]
    fn the_same_kind_of_variation_is_near_and_a_blur_far() {
        let (expected, other, faint) = (noise(1, 1.0), noise(2, 1.0), noise(3, 0.1));
        assert_eq!(value(&expected, &expected), 0.0);
        let shifted = (&expected + 5.0).unwrap();
        assert!(value(&shifted, &expected) < 1e-12, "brightness is no texture");
        assert!(value(&other, &expected) < 0.2, "{}", value(&other, &expected));
        assert!(value(&faint, &expected) > 0.8, "{}", value(&faint, &expected));
        let nothing = expected.zeros_like().unwrap();
        assert_eq!(value(&nothing, &nothing), 0.0);
    }

    #[test]
    fn gradients_match_finite_differences() {
        let (start, expected) = (noise(1, 0.7), noise(2, 1.0));
        let variable = Var::from_tensor(&start).unwrap();
        let gradients = texture(variable.as_tensor(), &expected).unwrap().backward().unwrap();
        let direction = noise(4, 1.0);
        let along = (gradients.get(&variable).unwrap() * &direction).unwrap().sum_all().unwrap();
        let along: f64 = along.to_scalar().unwrap();
        let at = |step: f64| value(&(&start + (&direction * step).unwrap()).unwrap(), &expected);
        let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
        assert!((along - difference).abs() < 1e-6 * difference.abs(), "{along} {difference}");
    }

    #[test]
    fn maps_too_small_for_a_tile_are_refused() {
        let small = Tensor::zeros((1, 3, 7, 16), DType::F64, &Device::Cpu).unwrap();
        assert!(texture(&small, &small).unwrap_err().to_string().contains("at least 8"));
    }
}
