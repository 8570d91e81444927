//! The spaces codes are optimised in: whitened, so that the model's own codes have unit variance in every direction
//! and one learning rate and one prior fit all of them.
//!
//! There are two. *Coordinates* are few and move all rows of a portrait together, as the model's portraits differ: along
//! its population's components, or, in a model without, by one row for all. *Rows* are free of one another.

use candle_core::{D, DType, Tensor};
use cnerf_core::{
    codes,
    model::{generator::Generator, population::Population},
    region::REGION_COUNT,
    rng::Stream,
};

use crate::error::Result;

/// Portraits drawn to measure the spread of codes.
const DRAWS: usize = 2048;
/// Rows of a portrait's codes.
const ROWS: usize = 2 * REGION_COUNT;
/// The first element of the stream drawn here.
const STREAM: u64 = 0x7370_6163;
/// Variance added to every direction, as a share of the mean variance: keeps dead directions from exploding.
const FLOOR: f64 = 1e-3;

/// Affine maps from coordinates and from whitened rows to the model's codes. Of a row w = mean + L u, with L Lᵀ the
/// covariance of the model's rows around their means.
#[derive(Clone, Debug)]
pub struct CodeSpace {
    /// Of each row, `[18, D]`.
    mean: Tensor,
    /// Lᵀ, `[D, D]`.
    spread: Tensor,
    /// L⁻ᵀ, `[D, D]`.
    inverse: Tensor,
    population: Option<Population>,
}

impl CodeSpace {
    /// Measures the model's codes on the portraits of the first seeds.
    pub fn measure(generator: &Generator) -> Result<Self> {
        let noise = Stream::new(0, &[STREAM]).normal_tensor(&[DRAWS, generator.noise_dim()], &generator.device())?;
        let codes = generator.codes_of(&noise)?.detach();
        let style_dim = codes.dim(D::Minus1)?;
        let codes = codes.reshape((DRAWS, ROWS, style_dim))?;
        let mean = codes.mean(0)?;
        let centred = codes.broadcast_sub(&mean)?.reshape((DRAWS * ROWS, style_dim))?;
        let covariance = (centred.t()?.matmul(&centred)? / (DRAWS * ROWS) as f64)?;
        let rows: Vec<Vec<f64>> = covariance.to_dtype(DType::F64)?.to_vec2()?;
        let length = rows.len();
        let lower = cholesky(rows);
        let transposed = |rows: &[Vec<f64>]| {
            let values: Vec<f32> =
                (0..length * length).map(|index| rows[index % length][index / length] as f32).collect();
            Tensor::from_vec(values, (length, length), codes.device())
        };
        let population = generator.population().cloned();
        Ok(Self { mean, spread: transposed(&lower)?, inverse: transposed(&inverted(&lower))?, population })
    }

    /// Number of coordinates: K of a population, else D.
    pub fn coordinate_count(&self) -> usize {
        self.population.as_ref().map_or(self.style_dim(), Population::size)
    }

    /// The model's codes `[1, 9, 2, D]` at coordinates `[1, K]`. Differentiable.
    pub fn at(&self, coordinates: &Tensor) -> Result<Tensor> {
        match &self.population {
            Some(population) => Ok(population.codes(coordinates)?),
            None => self.to_portrait(&coordinates.broadcast_as((ROWS, self.style_dim()))?),
        }
    }

    /// The coordinates `[1, K]` of the portrait nearest to `codes` `[1, 9, 2, D]`. Differentiable.
    pub fn coordinates(&self, codes: &Tensor) -> Result<Tensor> {
        match &self.population {
            Some(population) => Ok(population.coordinates(codes)?),
            None => Ok(self.whitened(codes)?.mean_keepdim(0)?),
        }
    }

    /// D, the length of a code row.
    pub fn style_dim(&self) -> usize {
        self.mean.dims().last().copied().unwrap_or(0)
    }

    /// The global code `[1, D]` of an upsampler driven by one, from a whitened one. Differentiable.
    pub fn to_global(&self, whitened: &Tensor) -> Result<Tensor> {
        Ok(self.displaced(whitened)?.broadcast_add(&self.mean.mean_keepdim(0)?)?)
    }

    /// The whitened rows `[18, D]` of codes `[1, 9, 2, D]`: undoes [`Self::to_portrait`].
    pub fn whitened(&self, codes: &Tensor) -> Result<Tensor> {
        Ok((codes.reshape(self.mean.shape())? - &self.mean)?.matmul(&self.inverse)?)
    }

    /// How far whitened displacements `[N, D]` move the model's codes, `[N, D]`. Differentiable.
    pub fn displaced(&self, whitened: &Tensor) -> Result<Tensor> {
        Ok(whitened.matmul(&self.spread)?)
    }

    /// The model's codes `[1, 9, 2, D]` of whitened rows `[18, D]`. Differentiable.
    pub fn to_portrait(&self, whitened: &Tensor) -> Result<Tensor> {
        let rows = (self.displaced(whitened)? + &self.mean)?;
        Ok(rows.reshape((1, REGION_COUNT, 2, self.style_dim()))?)
    }

    /// What one standard deviation along each coordinate adds to codes, `[K, 9, 2, D]`.
    pub fn components(&self) -> Result<Tensor> {
        match &self.population {
            Some(population) => Ok(population.components()?),
            None => Ok(codes::broadcast(&self.spread)?),
        }
    }
}

impl CodeSpace {
    /// `codes` `[1, 9, 2, D]` moved by `distance` (standard deviations along every coordinate) towards where a random
    /// portrait lies: a portrait near this one.
    pub fn near(&self, codes: &Tensor, distance: f64, random: &mut Stream) -> Result<Tensor> {
        let step = random.normal_tensor(&[1, self.coordinate_count()], codes.device())?;
        let moved = step.matmul(&self.components()?.flatten_from(1)?)?;
        Ok((codes + (moved.reshape(codes.shape())? * distance)?)?)
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
        let normals = |length: usize| Stream::new(1, &[]).normal_tensor(&[2000, length], &Device::Cpu).unwrap();
        let spread = |codes: &Tensor| -> Vec<f32> {
            let centred = codes.broadcast_sub(&codes.mean_keepdim(0).unwrap()).unwrap();
            centred.sqr().unwrap().mean(0).unwrap().sqrt().unwrap().to_vec1().unwrap()
        };
        let own = generator.codes_of(&normals(generator.noise_dim())).unwrap();
        let own = spread(&own.narrow(1, 0, 1).unwrap().narrow(2, 0, 1).unwrap().flatten_from(1).unwrap());
        for (found, expected) in spread(&space.displaced(&normals(space.style_dim())).unwrap()).iter().zip(&own) {
            assert!((found / expected - 1.0).abs() < 0.15, "{found} {expected}");
        }
        // Back and forth; directions without spread amplify f32's rounding.
        let white = normals(space.style_dim()).narrow(0, 0, ROWS).unwrap();
        let back = space.whitened(&space.to_portrait(&white).unwrap()).unwrap();
        let off = (back - &white).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(off < 1e-2, "{off}");
    }

    #[test]
    fn coordinates_of_a_population_come_back() {
        let generator = small_generator(3);
        let codes = generator.codes_of(&Stream::new(2, &[]).normal_tensor(&[40, 16], &Device::Cpu).unwrap()).unwrap();
        let noise = Stream::new(3, &[]).normal_tensor(codes.dims(), &Device::Cpu).unwrap();
        let codes = (codes + (noise * 0.1).unwrap()).unwrap().flatten_from(1).unwrap();
        let components = cnerf_core::train::whiten::principal_components(&codes, 5, 0).unwrap();
        let generator = generator.with_population(Some((&codes.mean(0).unwrap(), &components))).unwrap();
        let space = CodeSpace::measure(&generator).unwrap();
        assert_eq!((space.coordinate_count(), generator.noise_dim()), (5, 5));
        let coordinates = Tensor::new(&[[1f32, -2.0, 0.5, 0.0, 3.0]], &Device::Cpu).unwrap();
        let codes = space.at(&coordinates).unwrap();
        let off = |found: Tensor, expected: &Tensor| {
            (found - expected).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap()
        };
        assert!(off(space.coordinates(&codes).unwrap(), &coordinates) < 1e-3);
        assert!(off(space.to_portrait(&space.whitened(&codes).unwrap()).unwrap(), &codes) < 1e-3);
        assert_eq!(space.components().unwrap().dims(), [5, 9, 2, 16]);
    }
}
