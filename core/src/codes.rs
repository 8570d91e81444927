//! Latent codes: for every region one row for its shape and one for its texture, `[B, 9, 2, style_dim]`.

use candle_core::Tensor;
use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    region::{REGION_COUNT, RegionSet},
    rng::Stream,
};

/// Which half of a region's code an operation touches.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Aspect {
    /// Row 0: geometry and region mask.
    Shape,
    /// Row 1: colour and features.
    Texture,
    /// Both rows.
    Both,
}

impl Aspect {
    /// Whether the aspect covers a code row: 0 shape, 1 texture.
    pub const fn covers(self, row: usize) -> bool {
        matches!((self, row), (Self::Both, _) | (Self::Shape, 0) | (Self::Texture, 1))
    }
}

impl std::fmt::Display for Aspect {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Shape => "shape",
            Self::Texture => "texture",
            Self::Both => "shape and texture",
        })
    }
}

/// Checks that `codes` is `[B, 9, 2, style_dim]` and returns (B, style_dim).
pub fn dimensions(codes: &Tensor) -> Result<(usize, usize)> {
    match *codes.dims() {
        [batch, REGION_COUNT, 2, style_dim] => Ok((batch, style_dim)),
        _ => Err(Error::shape("codes", "[B, 9, 2, style_dim]", codes.dims())),
    }
}

/// One `w` per portrait, `[B, style_dim]`, given to every region and aspect: `[B, 9, 2, style_dim]`.
pub fn broadcast(w: &Tensor) -> Result<Tensor> {
    let (batch, style_dim) = w.dims2()?;
    Ok(w.reshape((batch, 1, 1, style_dim))?.expand((batch, REGION_COUNT, 2, style_dim))?.contiguous()?)
}

/// `target` with the rows of `regions` and `aspect` moved the fraction `amount` of the way to `source`.
/// An amount of 1 is a swap; amounts outside [0, 1] extrapolate.
pub fn blend(target: &Tensor, source: &Tensor, regions: RegionSet, aspect: Aspect, amount: f64) -> Result<Tensor> {
    let (batch, style_dim) = dimensions(target)?;
    if source.dims()[1..] != target.dims()[1..] {
        return Err(Error::shape("source codes", target.dims(), source.dims()));
    }
    let source = source.broadcast_as(target.shape())?;
    let selection = selection(regions, aspect, target)?.broadcast_as((batch, REGION_COUNT, 2, style_dim))?;
    // Rows that are not selected are copied, not multiplied by zero: they stay bit-identical.
    let moved = if amount == 1.0 { source } else { (target + ((source - target)? * amount)?)? };
    Ok(selection.where_cond(&moved, target)?)
}

/// Codes pulled towards `mean` (`[9, 2, style_dim]` or `[style_dim]`): `mean + psi * (codes - mean)`. Apply once.
pub fn truncate(codes: &Tensor, mean: &Tensor, psi: f64) -> Result<Tensor> {
    if psi == 1.0 {
        return Ok(codes.clone());
    }
    let mean = mean.broadcast_as(codes.shape())?;
    Ok((&mean + ((codes - &mean)? * psi)?)?)
}

/// Two-code mixing (paper, Local Semantic 3D Generator): for every portrait and region one of
/// shape/texture = first/first, first/second or second/second, uniformly.
/// `first`, `second`: `[B, style_dim]`; result `[B, 9, 2, style_dim]`.
pub fn mix(first: &Tensor, second: &Tensor, random: &mut Stream) -> Result<Tensor> {
    let (batch, _) = first.dims2()?;
    let picks: Vec<u8> = (0..batch * REGION_COUNT)
        .flat_map(|_| match random.below(3) {
            0 => [0, 0],
            1 => [0, 1],
            _ => [1, 1],
        })
        .collect();
    let (first, second) = (broadcast(first)?, broadcast(second)?);
    let picks = Tensor::from_vec(picks, (batch, REGION_COUNT, 2, 1), first.device())?.broadcast_as(first.shape())?;
    Ok(picks.where_cond(&second, &first)?)
}

/// 1 where a row is covered by `regions` and `aspect`, `[1, 9, 2, 1]`, u8.
fn selection(regions: RegionSet, aspect: Aspect, like: &Tensor) -> Result<Tensor> {
    let mut rows = vec![0u8; REGION_COUNT * 2];
    for region in regions.iter() {
        for row in 0..2 {
            rows[region.index() * 2 + row] = u8::from(aspect.covers(row));
        }
    }
    Ok(Tensor::from_vec(rows, (1, REGION_COUNT, 2, 1), like.device())?)
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::region::Region;

    fn random_codes(seed: u64) -> Tensor {
        Stream::new(seed, &[]).normal_tensor(&[2, 9, 2, 5], &Device::Cpu).unwrap()
    }

    #[test]
    fn a_swap_moves_the_named_rows_only() {
        let (target, source) = (random_codes(1), random_codes(2));
        let swapped = blend(&target, &source, Region::Hair.into(), Aspect::Texture, 1.0).unwrap();
        let rows = |t: &Tensor| t.reshape((2 * 18, 5)).unwrap().to_vec2::<f32>().unwrap();
        let (target, source, swapped) = (rows(&target), rows(&source), rows(&swapped));
        for (row, found) in swapped.iter().enumerate() {
            let hair_texture = row % 18 == Region::Hair.index() * 2 + 1;
            assert_eq!(found, &if hair_texture { &source } else { &target }[row]);
        }
    }

    #[test]
    fn truncation_is_applied_once() {
        let (codes, mean) = (random_codes(1), random_codes(2).get(0).unwrap());
        let half = truncate(&codes, &mean, 0.5).unwrap();
        let expected = ((&codes + mean.broadcast_as(codes.shape()).unwrap()).unwrap() * 0.5).unwrap();
        let error = (half - expected).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(error < 1e-6);
    }

    #[test]
    fn mixing_never_gives_second_shape_with_first_texture() {
        let first = Tensor::zeros((50, 1), candle_core::DType::F32, &Device::Cpu).unwrap();
        let second = first.ones_like().unwrap();
        let mixed = mix(&first, &second, &mut Stream::new(3, &[])).unwrap().flatten_all().unwrap();
        let pairs = mixed.to_vec1::<f32>().unwrap();
        let mut seen = [0; 3];
        for pair in pairs.chunks(2) {
            assert_ne!(pair, [1.0, 0.0]);
            seen[(pair[0] + pair[1]) as usize] += 1;
        }
        assert!(seen.iter().all(|count| *count > 100), "{seen:?}");
    }
}
