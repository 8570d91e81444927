//! Exponential moving average of weights (authors: EMA of the generator).

use std::collections::BTreeMap;

use candle_core::Tensor;

use crate::{
    error::{Error, Result},
    model::file::Tensors,
    parameters::Parameters,
};

const PREFIX: &str = "average.";

/// Averaged copies of weights.
pub struct Average {
    values: BTreeMap<String, Tensor>,
    half_life_images: f64,
}

impl Average {
    /// Starts at the weights as they are. After `half_life_images` pictures an old value counts half.
    pub fn of(parameters: &Parameters, half_life_images: f64) -> Result<Self> {
        Ok(Self { values: parameters.snapshot()?, half_life_images })
    }

    /// Moves towards the weights after `images` more pictures.
    pub fn update(&mut self, parameters: &Parameters, images: usize) -> Result<()> {
        let decay = 0.5f64.powf(images as f64 / self.half_life_images.max(1e-9));
        for (name, variable) in parameters.variables() {
            if let Some(value) = self.values.get_mut(&name) {
                *value = ((&*value * decay)? + (variable.as_tensor().detach() * (1.0 - decay))?)?;
            }
        }
        Ok(())
    }

    /// Sets `parameters` to the averages.
    pub fn apply(&self, parameters: &Parameters) -> Result<()> {
        parameters.restore(&self.values)
    }

    /// Adds the averages to a checkpoint.
    pub fn save(&self, tensors: &mut Tensors) {
        tensors.extend(self.values.iter().map(|(name, value)| (format!("{PREFIX}{name}"), value.clone())));
    }

    /// Reads what [`Self::save`] added.
    pub fn load(&mut self, tensors: &Tensors) -> Result<()> {
        for (name, value) in &mut self.values {
            let key = format!("{PREFIX}{name}");
            let saved = tensors.get(&key).ok_or_else(|| Error::shape(&key, value.dims(), &[]))?;
            if saved.dims() != value.dims() {
                return Err(Error::shape(key, value.dims(), saved.dims()));
            }
            *value = saved.to_device(value.device())?;
        }
        Ok(())
    }
}
