//! Opening portrait files together with the model they belong to.

use std::path::Path;

use anyhow::Context as _;
use cnerf_core::model::generator::Generator;
use cnerf_invert::{inverter::Opened, portrait::Portrait};

use crate::options::ModelOptions;

/// A portrait, its file's model, and both joined.
pub struct OpenPortrait {
    /// The file's content.
    pub portrait: Portrait,
    /// The model as it was before tuning.
    pub model: Generator,
    /// The tuned generator, codes and camera.
    pub opened: Opened,
}

/// Reads the portrait at `path` with the model it names, or with `--model`.
pub fn open(path: &Path, options: &ModelOptions) -> anyhow::Result<OpenPortrait> {
    let portrait = Portrait::load(path)?;
    let model = model_of(&portrait, path, options)?;
    let opened = Opened::new(&portrait, path, &model)?;
    Ok(OpenPortrait { portrait, model, opened })
}

/// The model a portrait was made with.
pub fn model_of(portrait: &Portrait, path: &Path, options: &ModelOptions) -> anyhow::Result<Generator> {
    options
        .load_or(&portrait.model.name)
        .with_context(|| format!("{}: its model is `{}`; pass --model FILE", path.display(), portrait.model.name))
}
