//! Opening portrait files together with the model they belong to.

use std::path::Path;

use anyhow::Context as _;
use cnerf_core::model::generator::Generator;
use cnerf_invert::{inverter::Opened, portrait::Portrait};

use crate::options::ModelOptions;

/// Reads the portrait at `path` with the model it names, or with `--model`, and joins them.
pub fn open(path: &Path, options: &ModelOptions) -> anyhow::Result<Opened> {
    let portrait = Portrait::load(path)?;
    let model = model_of(&portrait, path, options)?;
    Ok(Opened::new(&portrait, path, &model)?)
}

/// The model a portrait was made with.
pub fn model_of(portrait: &Portrait, path: &Path, options: &ModelOptions) -> anyhow::Result<Generator> {
    options
        .load_or(&portrait.model.name)
        .with_context(|| format!("{}: its model is `{}`; pass --model FILE", path.display(), portrait.model.name))
}
