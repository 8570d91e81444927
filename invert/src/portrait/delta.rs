//! Tuned weights as differences to a model's, small enough to keep with every portrait.

use std::{collections::BTreeMap, path::Path};

use candle_core::{DType, Tensor};
use cnerf_core::{
    Error as CoreError,
    model::{file::Tensors, generator::Generator},
};

use crate::error::{Error, Result};

/// Prefix of the stored tensors.
const PREFIX: &str = "delta.";

/// Differences by weight name, as they come back from a file: rounded to f16 relative to each tensor's scale.
#[derive(Clone, Debug, Default)]
pub struct Deltas(BTreeMap<String, Scaled>);

#[derive(Clone, Debug)]
struct Scaled {
    /// f16, at most 1 in size.
    values: Tensor,
    /// A power of two; the difference is `scale * values`.
    scale: f32,
}

impl Deltas {
    /// The differences `tuned - original`, of every weight of `tuned` that changed at all. Rounded at once, so that a
    /// portrait shows the same before it is saved and after it is read.
    pub fn between(original: &BTreeMap<String, Tensor>, tuned: &BTreeMap<String, Tensor>) -> Result<Self> {
        let mut deltas = BTreeMap::new();
        for (name, weight) in tuned {
            let Some(from) = original.get(name) else {
                return Err(CoreError::shape(name.as_str(), "a weight of the original model", weight.dims()).into());
            };
            let delta = (weight - from)?.to_dtype(DType::F32)?;
            let largest = delta.abs()?.flatten_all()?.max(0)?.to_scalar::<f32>()?;
            if largest == 0.0 {
                continue;
            }
            if !largest.is_finite() {
                return Err(CoreError::not_finite(format!("the tuned weight {name}")).into());
            }
            // A power of two scales without rounding; f16 then has its full 11 bits down to 2^-14 of the largest.
            let scale = largest.log2().ceil().clamp(-100.0, 100.0).exp2();
            let values = (delta / f64::from(scale))?.to_dtype(DType::F16)?;
            deltas.insert(name.clone(), Scaled { values, scale });
        }
        Ok(Self(deltas))
    }

    /// Whether no weight was tuned.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// How many numbers are kept.
    pub fn count(&self) -> usize {
        self.0.values().map(|delta| delta.values.elem_count()).sum()
    }

    /// Names of the tuned weights.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.0.keys().map(String::as_str)
    }

    /// The tuned weights: `original + delta`, only those that have one. Errs if a weight is missing from `original`
    /// or has another shape.
    pub fn applied(&self, original: &BTreeMap<String, Tensor>) -> Result<BTreeMap<String, Tensor>> {
        let mut tuned = BTreeMap::new();
        for (name, delta) in &self.0 {
            let from = original.get(name).filter(|weight| weight.dims() == delta.values.dims());
            let Some(from) = from else {
                return Err(CoreError::shape(name.as_str(), "a weight of the model", delta.values.dims()).into());
            };
            let difference = (delta.values.to_dtype(from.dtype())? * f64::from(delta.scale))?;
            tuned.insert(name.clone(), (from + difference.to_device(from.device())?)?);
        }
        Ok(tuned)
    }

    /// A copy of `model` with these differences added.
    pub fn generator(&self, model: &Generator) -> Result<Generator> {
        let copy = model.duplicate()?;
        copy.parameters().restore(&self.applied(&model.parameters().snapshot()?)?)?;
        Ok(copy)
    }

    /// Tensors and scales as a portrait file keeps them.
    pub(super) fn stored(&self) -> Result<(Tensors, BTreeMap<String, f32>)> {
        let tensors = self.0.iter().map(|(name, delta)| (format!("{PREFIX}{name}"), delta.values.clone())).collect();
        Ok((tensors, self.0.iter().map(|(name, delta)| (name.clone(), delta.scale)).collect()))
    }

    /// Takes what [`Self::stored`] wrote out of `tensors`.
    pub(super) fn from_stored(path: &Path, tensors: &mut Tensors, scales: &BTreeMap<String, f32>) -> Result<Self> {
        let mut deltas = BTreeMap::new();
        for (name, scale) in scales {
            let values = tensors.remove(&format!("{PREFIX}{name}")).filter(|values| values.dtype() == DType::F16);
            let Some(values) = values else {
                return Err(Error::malformed(path, format!("tensor `{PREFIX}{name}` is missing or not f16")));
            };
            let bounded = values.flatten_all()?.to_dtype(DType::F32)?.to_vec1::<f32>()?;
            if !scale.is_finite()
                || scale.abs() > 1e6
                || bounded.iter().any(|value| value.abs() > 1.0 || value.is_nan())
            {
                return Err(Error::malformed(path, format!("tensor `{PREFIX}{name}` has values out of range")));
            }
            deltas.insert(name.clone(), Scaled { values, scale: *scale });
        }
        Ok(Self(deltas))
    }
}
