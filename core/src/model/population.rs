//! The portraits a model knows: principal components of the codes its training portraits have.
//!
//! A warm-up gives every region of every training portrait a code of its own. Noise sent through the mapping network knows
//! nothing of those, and portraits drawn so look like brothers; coordinates along the components of the codes themselves
//! vary as the training portraits do, all regions of a head together.

use candle_core::Tensor;

use crate::{
    codes,
    error::{Error, Result},
    parameters::{Init, Parameters},
    region::REGION_COUNT,
};

/// Squared lengths of components below this count as no component.
const LEAST_VARIANCE: f64 = 1e-12;

/// Mean and principal components of codes `[9, 2, D]`.
#[derive(Clone, Debug)]
pub struct Population {
    /// `[1, 18 D]`.
    mean: Tensor,
    /// `[K, 18 D]`, orthogonal, each as long as the codes' standard deviation along it.
    components: Tensor,
    style_dim: usize,
}

impl Population {
    /// The population of `size` components under `parameters`: `mean` `[18 D]` and `components` `[K, 18 D]`.
    pub fn new(size: usize, style_dim: usize, parameters: &Parameters) -> Result<Self> {
        let length = REGION_COUNT * 2 * style_dim;
        let mean = parameters.get("mean", &[length], Init::Constant(0.0))?.unsqueeze(0)?;
        Ok(Self { mean, components: parameters.get("components", &[size, length], Init::Constant(0.0))?, style_dim })
    }

    /// K.
    pub fn size(&self) -> usize {
        self.components.dims().first().copied().unwrap_or(0)
    }

    /// The mean portrait's codes, `[1, 9, 2, D]`.
    pub fn mean(&self) -> Result<Tensor> {
        Ok(self.mean.reshape((1, REGION_COUNT, 2, self.style_dim))?)
    }

    /// What steps of one standard deviation along each component add to codes, `[K, 9, 2, D]`.
    pub fn components(&self) -> Result<Tensor> {
        Ok(self.components.reshape((self.size(), REGION_COUNT, 2, self.style_dim))?)
    }

    /// Codes `[B, 9, 2, D]` at coordinates `[B, K]` in standard deviations. Differentiable.
    pub fn codes(&self, coordinates: &Tensor) -> Result<Tensor> {
        let (batch, size) = coordinates.dims2()?;
        if size != self.size() {
            return Err(Error::shape("coordinates", format!("[B, {}]", self.size()), coordinates.dims()));
        }
        let codes = coordinates.matmul(&self.components)?.broadcast_add(&self.mean)?;
        Ok(codes.reshape((batch, REGION_COUNT, 2, self.style_dim))?)
    }

    /// Coordinates `[B, K]` of the codes nearest to `codes` `[B, 9, 2, D]`. Differentiable.
    pub fn coordinates(&self, codes: &Tensor) -> Result<Tensor> {
        codes::dimensions(codes)?;
        let centred = codes.flatten_from(1)?.broadcast_sub(&self.mean)?;
        let variances = (self.components.sqr()?.sum(1)? + LEAST_VARIANCE)?;
        Ok(centred.matmul(&self.components.t()?)?.broadcast_div(&variances)?)
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;

    #[test]
    fn coordinates_come_back_from_codes() {
        let parameters = Parameters::fresh(0, DType::F32, &Device::Cpu);
        let population = Population::new(2, 2, &parameters).unwrap();
        let mut components = vec![0f32; 2 * 36];
        (components[3], components[36 + 7]) = (2.0, -0.5);
        for (name, variable) in parameters.variables() {
            match name.as_str() {
                "mean" => variable.set(&Tensor::ones(36, DType::F32, &Device::Cpu).unwrap()).unwrap(),
                _ => variable.set(&Tensor::from_slice(&components, (2, 36), &Device::Cpu).unwrap()).unwrap(),
            }
        }
        let coordinates = Tensor::new(&[[1f32, -3.0], [0.5, 0.0]], &Device::Cpu).unwrap();
        let codes = population.codes(&coordinates).unwrap();
        assert_eq!(codes.dims(), [2, 9, 2, 2]);
        assert_eq!(codes.get(0).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()[3], 3.0);
        let back = population.coordinates(&codes).unwrap().to_vec2::<f32>().unwrap();
        assert_eq!(back, coordinates.to_vec2::<f32>().unwrap());
        assert!(population.codes(&Tensor::zeros((1, 3), DType::F32, &Device::Cpu).unwrap()).is_err());
    }
}
