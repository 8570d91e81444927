//! An inversion's state on disk, from which it goes on as if it had never stopped.
//!
//! A checkpoint holds what steps have changed: codes, cameras, tuned weights, the optimiser's moments. Photos, targets
//! and the model are read anew; a fingerprint of them and of the configuration tells whether they are the same.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use candle_core::Tensor;
use cnerf_core::model::file::{self, Tensors};
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

const HEADER_KEY: &str = "cnerf-inversion";

/// What a checkpoint says of itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CheckpointHeader {
    /// Of photos, model and configuration.
    pub fingerprint: String,
    /// Steps of the pivot done.
    pub pivot_steps: usize,
    /// The tuning, if it has begun.
    pub tune: Option<TuneState>,
    /// Time spent so far, seconds.
    pub seconds: f64,
}

/// The numbers of a tuning under way.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TuneState {
    /// Steps done.
    pub steps: usize,
    /// The averaged loss.
    pub smoothed: Option<f64>,
    /// Its lowest value; none before the first step.
    pub lowest: Option<f64>,
    /// Steps since then.
    pub since_lowest: usize,
    /// The loss of the best weights.
    pub best_loss: Option<f64>,
}

/// Where the checkpoint of the portrait `output` lies: beside it, as `NAME.cnerf.part`.
pub fn path_of(output: &Path) -> PathBuf {
    let mut name = output.as_os_str().to_owned();
    name.push(".part");
    name.into()
}

pub(crate) fn write(path: &Path, header: &CheckpointHeader, tensors: &Tensors) -> Result<()> {
    let header = serde_json::to_string(header).map_err(|error| Error::malformed(path, error))?;
    Ok(file::write_safetensors(path, tensors, &[(HEADER_KEY, header)])?)
}

pub(crate) fn read(path: &Path) -> Result<(CheckpointHeader, Tensors)> {
    let (tensors, metadata) = file::parse_safetensors(path, &file::read_bytes(path)?)?;
    let header = file::header_of(path, &metadata, HEADER_KEY, "an inversion that was stopped")?;
    Ok((header, tensors))
}

/// The tensor `name` of a checkpoint, of the shape it must have.
pub(crate) fn take(tensors: &Tensors, name: &str, shape: &[usize]) -> Result<Tensor> {
    let found = tensors.get(name).filter(|tensor| tensor.dims() == shape);
    found.cloned().ok_or_else(|| {
        let dims = tensors.get(name).map(|tensor| tensor.dims().to_vec()).unwrap_or_default();
        cnerf_core::Error::shape(name, shape, &dims).into()
    })
}

/// Adds `values` under `prefix`.
pub(crate) fn put_all(tensors: &mut Tensors, prefix: &str, values: impl IntoIterator<Item = (String, Tensor)>) {
    tensors.extend(values.into_iter().map(|(name, value)| (format!("{prefix}.{name}"), value)));
}

/// What [`put_all`] added.
pub(crate) fn all_of(tensors: &Tensors, prefix: &str) -> BTreeMap<String, Tensor> {
    let below = |(name, value): (&String, &Tensor)| {
        let name = name.strip_prefix(prefix)?.strip_prefix('.')?;
        Some((name.to_owned(), value.clone()))
    };
    tensors.iter().filter_map(below).collect()
}
