//! `cnerf info`: what a model, portrait or dataset holds.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;
use cnerf_core::{
    data::dataset::Dataset,
    model::{file, generator::Generator},
};
use cnerf_invert::portrait::Portrait;
use serde_json::{Value, json};

use crate::console::{Console, Outcome};

/// Arguments of `cnerf info`.
#[derive(Args, Debug)]
pub struct InfoArguments {
    /// A model, a portrait, a dataset, or the name of a built-in model
    file: PathBuf,
}

impl InfoArguments {
    /// Looks and tells.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        let value = describe(&self.file)?;
        console.result(&value, || serde_json::to_string_pretty(&value).unwrap_or_default())?;
        Ok(Outcome::Done)
    }
}

fn describe(path: &Path) -> anyhow::Result<Value> {
    let name = path.to_string_lossy();
    if let Some(bytes) = cnerf_models::bytes(&name) {
        return model(path, bytes);
    }
    if !path.exists() {
        bail!("{}: no such file; built-in models are {}", path.display(), cnerf_models::NAMES.join(" and "));
    }
    let extension = path.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase());
    match extension.as_deref() {
        _ if path.is_dir() => dataset(path),
        Some("zip") => dataset(path),
        Some("cnerf") => portrait(path),
        Some("safetensors") => model(path, &file::read_bytes(path)?),
        _ => bail!("{}: not a .safetensors model, a .cnerf portrait or a dataset (folder or .zip)", path.display()),
    }
}

fn model(path: &Path, bytes: &[u8]) -> anyhow::Result<Value> {
    let generator = Generator::from_bytes(path, bytes, &candle_core::Device::Cpu)?;
    let header = generator.header();
    Ok(json!({
        "kind": "model",
        "file": path,
        "bytes": bytes.len(),
        "preset": header.map(|header| &header.preset),
        "provenance": header.map(|header| &header.provenance),
        "hash": header.map(|header| &header.hash),
        "parameters": generator.parameters().count(),
        "render_resolution": generator.render_resolution(),
        "output_resolution": generator.output_resolution(),
        "config": generator.config(),
    }))
}

fn portrait(path: &Path) -> anyhow::Result<Value> {
    let portrait = Portrait::load(path)?;
    let edits: Vec<_> = portrait.history.iter().map(|(record, _)| record).collect();
    Ok(json!({
        "kind": "portrait",
        "file": path,
        "bytes": std::fs::metadata(path)?.len(),
        "model": portrait.model.name,
        "model_hash": portrait.model.hash,
        "source": portrait.source,
        "camera": portrait.camera,
        "metrics": portrait.metrics,
        "edits": edits,
        "config": portrait.config,
    }))
}

fn dataset(path: &Path) -> anyhow::Result<Value> {
    let dataset = Dataset::open(path)?;
    let with_camera = dataset.entries().iter().filter(|entry| entry.camera.is_some()).count();
    let with_mask = dataset.entries().iter().filter(|entry| entry.mask.is_some()).count();
    Ok(json!({
        "kind": "dataset",
        "file": path,
        "items": dataset.len(),
        "with_mask": with_mask,
        "with_camera": with_camera,
    }))
}
