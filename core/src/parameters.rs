//! Named weights: how networks get theirs, whether drawn anew from a seed or read from a file, and in a fixed order.
//!
//! candle's own `VarMap` is unordered and draws from a global generator; training here must give the same bytes for
//! the same seed, so every tensor is drawn from a stream named by the tensor itself.

use std::{
    collections::{BTreeMap, HashMap},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use candle_core::{DType, Device, Tensor, Var};

use crate::{
    error::{Error, Result},
    rng::Stream,
};

/// How a weight starts when it is not read from a file.
#[derive(Clone, Copy, Debug)]
pub enum Init {
    /// All values the same.
    Constant(f64),
    /// Uniform in ±bound.
    Uniform(f64),
    /// Normal with this standard deviation.
    Normal(f64),
    /// Ones on the diagonal of the last two dimensions, zeros elsewhere.
    Identity,
}

struct Store {
    seed: u64,
    dtype: DType,
    device: Device,
    source: Option<HashMap<String, Tensor>>,
    variables: BTreeMap<String, Var>,
}

/// Hands out weights by dotted name, and keeps them.
#[derive(Clone)]
pub struct Parameters {
    store: Arc<Mutex<Store>>,
    prefix: String,
    frozen: bool,
}

impl Parameters {
    /// Weights drawn anew: each a function of `seed` and its name.
    pub fn fresh(seed: u64, dtype: DType, device: &Device) -> Self {
        Self::new(seed, dtype, device, None)
    }

    /// Weights read from `tensors`; asking for one that is missing or has another shape is an error.
    pub fn loaded(tensors: HashMap<String, Tensor>, dtype: DType, device: &Device) -> Self {
        Self::new(0, dtype, device, Some(tensors))
    }

    fn new(seed: u64, dtype: DType, device: &Device, source: Option<HashMap<String, Tensor>>) -> Self {
        let store = Store { seed, dtype, device: device.clone(), source, variables: BTreeMap::new() };
        Self { store: Arc::new(Mutex::new(store)), prefix: String::new(), frozen: false }
    }

    fn store(&self) -> MutexGuard<'_, Store> {
        self.store.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The same weights seen from below `name`.
    #[must_use]
    pub fn within(&self, name: impl std::fmt::Display) -> Self {
        Self { store: Arc::clone(&self.store), prefix: format!("{}{name}.", self.prefix), frozen: self.frozen }
    }

    /// The same weights, which change as these do, for networks that gradients pass through without reaching them.
    #[must_use]
    pub fn frozen(&self) -> Self {
        Self { frozen: true, ..self.clone() }
    }

    /// The element type of all weights.
    pub fn dtype(&self) -> DType {
        self.store().dtype
    }

    /// The device of all weights.
    pub fn device(&self) -> Device {
        self.store().device.clone()
    }

    /// The weight called `name` here. The tensor shares its storage with the trainable variable.
    pub fn get(&self, name: &str, shape: &[usize], init: Init) -> Result<Tensor> {
        let tensor = self.shared(name, shape, init)?;
        Ok(if self.frozen { tensor.detach() } else { tensor })
    }

    fn shared(&self, name: &str, shape: &[usize], init: Init) -> Result<Tensor> {
        let name = format!("{}{name}", self.prefix);
        let mut store = self.store();
        if let Some(variable) = store.variables.get(&name) {
            if variable.dims() != shape {
                return Err(Error::shape(name, shape, variable.dims()));
            }
            return Ok(variable.as_tensor().clone());
        }
        let value = match &store.source {
            Some(tensors) => {
                let tensor = tensors.get(&name).ok_or_else(|| Error::shape(name.clone(), shape, &[]))?;
                if tensor.dims() != shape {
                    return Err(Error::shape(name, shape, tensor.dims()));
                }
                tensor.to_device(&store.device)?.to_dtype(store.dtype)?.copy()?
            }
            None => draw(store.seed, &name, shape, init, &store.device)?.to_dtype(store.dtype)?,
        };
        let variable = Var::from_tensor(&value)?;
        let tensor = variable.as_tensor().clone();
        store.variables.insert(name, variable);
        Ok(tensor)
    }

    /// All variables at or below this prefix by full name, in name order.
    pub fn variables(&self) -> Vec<(String, Var)> {
        let store = self.store();
        let below = store.variables.iter().filter(|(name, _)| name.starts_with(&self.prefix));
        below.map(|(name, variable)| (name.clone(), variable.clone())).collect()
    }

    /// Copies of all values at or below this prefix by full name.
    pub fn snapshot(&self) -> Result<BTreeMap<String, Tensor>> {
        self.variables().into_iter().map(|(name, variable)| Ok((name, variable.as_tensor().copy()?.detach()))).collect()
    }

    /// Overwrites values by full name; names not present in `values` keep theirs.
    pub fn restore(&self, values: &BTreeMap<String, Tensor>) -> Result<()> {
        for (name, variable) in self.variables() {
            if let Some(value) = values.get(&name) {
                if value.dims() != variable.dims() {
                    return Err(Error::shape(name, variable.dims(), value.dims()));
                }
                variable.set(&value.to_device(variable.device())?.to_dtype(variable.dtype())?)?;
            }
        }
        Ok(())
    }

    /// Number of scalars at or below this prefix.
    pub fn count(&self) -> usize {
        self.variables().iter().map(|(_, variable)| variable.elem_count()).sum()
    }
}

fn draw(seed: u64, name: &str, shape: &[usize], init: Init, device: &Device) -> Result<Tensor> {
    // FNV-1a of the name picks the stream: adding a weight to a network changes no other's start.
    let hash = name
        .bytes()
        .fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3));
    let mut random = Stream::new(seed, &[hash]);
    Ok(match init {
        Init::Constant(value) => Tensor::full(value as f32, shape, device)?,
        Init::Uniform(bound) => random.uniform_tensor(shape, -bound as f32, bound as f32, device)?,
        Init::Normal(deviation) => (random.normal_tensor(shape, device)? * deviation)?,
        Init::Identity => match *shape {
            [.., rows, columns] => {
                let diagonal = |index| ((index / columns) % rows == index % columns) as u8 as f32;
                let values: Vec<f32> = (0..shape.iter().product()).map(diagonal).collect();
                Tensor::from_vec(values, shape, device)?
            }
            _ => return Err(Error::shape(name, "[.., rows, columns]", shape)),
        },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frozen_weights_follow_their_variables_and_take_no_gradient() {
        let parameters = Parameters::fresh(1, DType::F64, &Device::Cpu);
        let get =
            |parameters: &Parameters| parameters.within("layer").get("weight", &[2], Init::Constant(1.0)).unwrap();
        let (own, frozen) = (get(&parameters), get(&parameters.frozen()));
        let (_, variable) = parameters.variables().remove(0);
        variable.set(&Tensor::new(&[3f64, 4.0], &Device::Cpu).unwrap()).unwrap();
        assert_eq!(frozen.to_vec1::<f64>().unwrap(), [3.0, 4.0]);
        let gradients = (&own * &frozen).unwrap().sum_all().unwrap().backward().unwrap();
        assert_eq!(gradients.get(&own).unwrap().to_vec1::<f64>().unwrap(), [3.0, 4.0], "not twice");
    }
}
