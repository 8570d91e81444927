//! From noise to codes: the mapping network z → w.

use candle_core::Tensor;

use crate::{
    error::{Error, Result},
    parameters::{Init, Parameters},
};

/// Depth of the mapping network (paper, Network Details).
pub const MAPPING_LAYERS: usize = 3;
/// Slope of the leaky ReLU below zero (authors' code).
const LEAK: f64 = 0.2;

/// `layers` fully connected layers of `style_dim` units, a leaky ReLU after every one of them.
#[derive(Clone, Debug)]
pub struct Mapping {
    layers: Vec<(Tensor, Tensor)>,
}

impl Mapping {
    /// Weights `{layer}.weight` `[D, D]` and `{layer}.bias` `[D]`. Fresh ones are Kaiming-normal for the leak, with
    /// zero biases.
    pub fn new(style_dim: usize, layers: usize, parameters: &Parameters) -> Result<Self> {
        let deviation = (2.0 / ((1.0 + LEAK * LEAK) * style_dim as f64)).sqrt();
        let layers = (0..layers)
            .map(|layer| {
                let parameters = parameters.within(layer);
                let weight = parameters.get("weight", &[style_dim, style_dim], Init::Normal(deviation))?;
                Ok((weight, parameters.get("bias", &[style_dim], Init::Constant(0.0))?))
            })
            .collect::<Result<_>>()?;
        Ok(Self { layers })
    }

    /// z `[B, D]`, standard normal, to w `[B, D]`.
    pub fn forward(&self, z: &Tensor) -> Result<Tensor> {
        self.layers.iter().try_fold(z.clone(), |hidden, (weight, bias)| {
            if hidden.dim(candle_core::D::Minus1)? != weight.dim(1)? {
                return Err(Error::shape("z", format!("[B, {}]", weight.dim(1)?), z.dims()));
            }
            let linear = hidden.matmul(&weight.t()?)?.broadcast_add(bias)?;
            // x = relu(x) - leak relu(-x): unlike maximum(x, leak x), its gradient at 0 is not counted twice.
            Ok((linear.relu()? - (linear.neg()?.relu()? * LEAK)?)?)
        })
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;
    use crate::rng::Stream;

    #[test]
    fn the_signal_keeps_its_scale_through_the_layers() {
        let device = Device::Cpu;
        let mapping = Mapping::new(64, MAPPING_LAYERS, &Parameters::fresh(1, DType::F32, &device)).unwrap();
        let z = Stream::new(2, &[]).normal_tensor(&[256, 64], &device).unwrap();
        let w = mapping.forward(&z).unwrap();
        let power = w.sqr().unwrap().mean_all().unwrap().to_scalar::<f32>().unwrap();
        assert!((0.5..2.0).contains(&power), "mean square {power}");
    }

    #[test]
    fn negative_values_leak() {
        let device = Device::Cpu;
        let one = Tensor::ones((1, 1), DType::F64, &device).unwrap();
        let weights = [("0.weight".into(), one), ("0.bias".into(), Tensor::zeros(1, DType::F64, &device).unwrap())];
        let parameters = Parameters::loaded(weights.into_iter().collect(), DType::F64, &device);
        let mapping = Mapping::new(1, 1, &parameters).unwrap();
        let w = mapping.forward(&Tensor::new(&[[-2.0], [3.0]], &device).unwrap()).unwrap();
        assert_eq!(w.to_vec2::<f64>().unwrap(), [[-0.4], [3.0]]);
    }
}
