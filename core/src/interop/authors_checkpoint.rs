//! The authors' checkpoints as generators of ours.

use std::{
    collections::{BTreeMap, HashMap},
    path::Path,
};

use candle_core::{Device, Tensor};

use crate::{
    config::GeneratorConfig,
    error::{Error, Result},
    interop::{authors::import_authors_field, authors_nets, torch},
    model::generator::{Generator, STATISTICS},
};

/// The authors' deviation of azimuth and elevation, radians (FFHQ).
const CAMERA_DEVIATION_RAD: [f64; 2] = [0.3, 0.15];
/// The authors' samples per ray.
const SAMPLES: usize = 24;

/// The generator of a stage-1 or a full checkpoint: its moving average `g_ema`, or `g` when `raw`. Regions are put in
/// our order. A stage-1 checkpoint has no upsampler.
///
/// # Errors
/// If the file is no such checkpoint; nothing in it is executed.
pub fn read(path: &Path, raw: bool) -> Result<Generator> {
    let checkpoint = torch::read_checkpoint(path)?;
    let name = if raw { "g" } else { "g_ema" };
    let state = checkpoint.get(name).ok_or_else(|| {
        Error::malformed(path, format!("holds no `{name}`; the authors' checkpoints hold g, g_ema and discriminators"))
    })?;
    let state: HashMap<String, Tensor> = state.flatten().into_iter().collect();
    generator(&state).map_err(|error| match error {
        Error::Shape { .. } | Error::Config { .. } => Error::malformed(path, error),
        other => other,
    })
}

/// The generator of one state dict of the authors'.
pub fn generator(state: &HashMap<String, Tensor>) -> Result<Generator> {
    let (field, weights) = import_authors_field(state)?;
    let mut tensors: BTreeMap<String, Tensor> = weights.into_iter().collect();
    let has_upsampler = state.keys().any(|name| name.starts_with("decoder."));
    let upsampler = has_upsampler.then(|| authors_nets::upsampler_config(state)).transpose()?;
    if let Some(config) = &upsampler {
        let weights = authors_nets::upsampler_weights(config, state)?;
        tensors.extend(weights.into_iter().map(|(name, tensor)| (format!("upsampler.{name}"), tensor)));
    }
    let style_dim = field.style_dim;
    for (name, value) in [("z_mean", 0f32), ("z_deviation", 1.0), ("w_mean", 0.0)] {
        tensors.insert(format!("{STATISTICS}.{name}"), Tensor::full(value, style_dim, &Device::Cpu)?);
    }
    let config = GeneratorConfig {
        field,
        upsampler,
        camera_deviation_rad: CAMERA_DEVIATION_RAD,
        samples: SAMPLES,
        population: 0,
    };
    let generator = Generator::from_tensors(&config, tensors, &Device::Cpu)?;
    generator.measure(None)?;
    Ok(generator)
}
