//! The space codes are optimised in: whitened, so that the model's own codes have unit variance in every direction
//! and one learning rate and one prior fit all of them.

use candle_core::{D, DType, Tensor};
use cnerf_core::{model::generator::Generator, region::REGION_COUNT, rng::Stream};

use crate::error::Result;

/// Portraits drawn to measure the spread of codes.
const DRAWS: u64 = 2048;
/// Variance added to every direction, as a share of the mean variance: keeps dead directions from exploding.
const FLOOR: f64 = 1e-3;

/// An affine map from whitened codes u to the model's codes: w = mean + L u, with L Lᵀ the covariance of w.
#[derive(Clone, Debug)]
pub struct CodeSpace {
    /// `[D]`.
    mean: Tensor,
    /// Lᵀ, `[D, D]`.
    spread: Tensor,
    /// L⁻ᵀ, `[D, D]`.
    inverse: Tensor,
}

impl CodeSpace {
    /// Measures the model's codes on the portraits of the first seeds.
    pub fn measure(generator: &Generator) -> Result<Self> {
        let draws = (0..DRAWS).map(|seed| generator.draw_z(seed)).collect::<cnerf_core::Result<Vec<_>>>()?;
        let codes = generator.map(&Tensor::cat(&draws, 0)?)?.detach();
        let mean = codes.mean(0)?;
        let centred = codes.broadcast_sub(&mean)?;
        let covariance = (centred.t()?.matmul(&centred)? / DRAWS as f64)?;
        let rows: Vec<Vec<f64>> = covariance.to_dtype(DType::F64)?.to_vec2()?;
        let length = rows.len();
        let lower = cholesky(rows);
        let transposed = |rows: &[Vec<f64>]| {
            let values: Vec<f32> =
                (0..length * length).map(|index| rows[index % length][index / length] as f32).collect();
            Tensor::from_vec(values, (length, length), codes.device())
        };
        Ok(Self { mean, spread: transposed(&lower)?, inverse: transposed(&inverted(&lower))? })
    }

    /// D, the length of a code row.
    pub fn style_dim(&self) -> usize {
        self.mean.elem_count()
    }

    /// The model's codes `[N, D]` of whitened ones `[N, D]`. Differentiable.
    pub fn to_codes(&self, whitened: &Tensor) -> Result<Tensor> {
        Ok(self.displaced(whitened)?.broadcast_add(&self.mean)?)
    }

    /// The whitened codes `[N, D]` of the model's `[N, D]`: undoes [`Self::to_codes`].
    pub fn whitened(&self, codes: &Tensor) -> Result<Tensor> {
        Ok(codes.broadcast_sub(&self.mean)?.matmul(&self.inverse)?)
    }

    /// How far whitened displacements `[N, D]` move the model's codes, `[N, D]`. Differentiable.
    pub fn displaced(&self, whitened: &Tensor) -> Result<Tensor> {
        Ok(whitened.matmul(&self.spread)?)
    }

    /// The model's codes `[1, 9, 2, D]` of whitened rows `[18, D]`, or of one row `[1, D]` given to all of them.
    pub fn to_portrait(&self, whitened: &Tensor) -> Result<Tensor> {
        let style_dim = whitened.dim(D::Minus1)?;
        let rows = self.to_codes(whitened)?.broadcast_as((REGION_COUNT * 2, style_dim))?;
        Ok(rows.reshape((1, REGION_COUNT, 2, style_dim))?)
    }
}

impl CodeSpace {
    /// `codes` `[1, 9, 2, D]` moved by `distance` (root mean square, whitened units) towards where a random portrait
    /// lies, all rows alike: a portrait near this one.
    pub fn near(&self, codes: &Tensor, distance: f64, random: &mut Stream) -> Result<Tensor> {
        let step = random.normal_tensor(&[1, self.style_dim()], codes.device())?;
        let moved = (step.matmul(&self.spread)? * distance)?;
        Ok(codes.broadcast_add(&moved.reshape((1, 1, 1, self.style_dim()))?)?)
    }
}

/// The lower triangle L with L Lᵀ = `matrix` plus [`FLOOR`].
fn cholesky(mut matrix: Vec<Vec<f64>>) -> Vec<Vec<f64>> {
    let length = matrix.len();
    let trace: f64 = (0..length).map(|index| matrix[index][index]).sum();
    let floor = FLOOR * trace / length.max(1) as f64 + 1e-12;
    for row in 0..length {
        matrix[row][row] += floor;
        for column in 0..=row {
            let sum: f64 = (0..column).map(|k| matrix[row][k] * matrix[column][k]).sum();
            let rest = matrix[row][column] - sum;
            matrix[row][column] = if row == column { rest.max(floor).sqrt() } else { rest / matrix[column][column] };
        }
        matrix[row][row + 1..].fill(0.0);
    }
    matrix
}

/// The inverse of a lower triangle with a positive diagonal.
fn inverted(lower: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let length = lower.len();
    let mut inverse = vec![vec![0.0; length]; length];
    for (row, line) in lower.iter().enumerate() {
        let solved = |column: usize| {
            let sum: f64 = (column..row).map(|k| line[k] * inverse[k][column]).sum();
            (if row == column { 1.0 } else { 0.0 } - sum) / line[row]
        };
        let values: Vec<f64> = (0..=row).map(solved).collect();
        inverse[row][..=row].copy_from_slice(&values);
    }
    inverse
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::inverter::tests::small_generator;

    #[test]
    fn whitened_normals_have_the_models_spread() {
        let generator = small_generator(3);
        let space = CodeSpace::measure(&generator).unwrap();
        let white = Stream::new(1, &[]).normal_tensor(&[4000, space.style_dim()], &Device::Cpu).unwrap();
        let spread = |codes: &Tensor| -> Vec<f32> {
            let centred = codes.broadcast_sub(&codes.mean_keepdim(0).unwrap()).unwrap();
            centred.sqr().unwrap().mean(0).unwrap().sqrt().unwrap().to_vec1().unwrap()
        };
        let draws: Vec<Tensor> = (5000..7000).map(|seed| generator.draw_z(seed).unwrap()).collect();
        let own = spread(&generator.map(&Tensor::cat(&draws, 0).unwrap()).unwrap());
        for (found, expected) in spread(&space.to_codes(&white).unwrap()).iter().zip(&own) {
            assert!((found / expected - 1.0).abs() < 0.15, "{found} {expected}");
        }
        // Back and forth; directions without spread amplify f32's rounding.
        let back = space.whitened(&space.to_codes(&white).unwrap()).unwrap();
        let off = (back - &white).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(off < 1e-2, "{off}");
        let zero = Tensor::zeros((1, space.style_dim()), DType::F32, &Device::Cpu).unwrap();
        assert_eq!(space.to_portrait(&zero).unwrap().dims(), [1, 9, 2, space.style_dim()]);
    }
}
