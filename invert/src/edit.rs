//! Edits: rows of a portrait's codes moved to another portrait's, a seed's or the mean's, and what that changed.

use std::path::Path;

use candle_core::Tensor;
use cnerf_core::{
    codes::{self, Aspect},
    data::{labels::LabelMap, picture},
    eval::quality,
    model::generator::{Generator, Picture},
    region::{Region, RegionSet},
};
use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    inverter::{Opened, one_picture},
    objective,
    portrait::{EditRecord, Portrait, Undo},
};

/// Where an edit's codes come from.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// Another portrait file of the same model, by the name it was given.
    Portrait(String),
    /// The random portrait of this seed, as `generate --seeds` makes it.
    Seed(u64),
    /// The model's mean portrait.
    Mean,
}

/// What to change.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edit {
    /// Which regions.
    pub regions: RegionSet,
    /// Their shape, texture or both.
    pub aspect: Aspect,
    /// Towards what.
    pub source: Source,
    /// How far: 0 nothing, 1 all the way; beyond 1 exaggerates.
    pub amount: f64,
}

/// What an edit changed in the portrait's own view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Change {
    /// Mean absolute colour change, in [0, 1], where the edited regions were or are.
    pub inside_change: f64,
    /// Mean absolute colour change, in [0, 1], elsewhere.
    pub outside_change: f64,
    /// Mean absolute depth change over the picture, world units.
    pub depth_change: f64,
}

/// An edit's outcome, to be looked at.
#[derive(Clone, Debug)]
pub struct Edited {
    /// What all the edits together changed.
    pub change: Change,
    /// The portrait before, in its own view.
    pub before: RgbImage,
    /// The portrait after.
    pub after: RgbImage,
    /// Regions after.
    pub regions: RgbImage,
}

/// The codes `[1, 9, 2, D]` an edit goes towards. `other` is the portrait a [`Source::Portrait`] names; it must belong
/// to the same model, which [`crate::inverter::Opened`] checks.
pub fn source_codes(model: &Generator, source: &Source, other: Option<&Portrait>) -> Result<Tensor> {
    Ok(match (source, other) {
        (Source::Seed(seed), _) => model.codes_from_seed(*seed, 1.0)?,
        (Source::Mean, _) => model.mean_codes()?,
        (Source::Portrait(_), Some(portrait)) => portrait.codes.unsqueeze(0)?.to_device(&model.device())?,
        (Source::Portrait(name), None) => return Err(Error::config("--from", format!("{name} was not read"))),
    })
}

/// Applies edits in order, each with the codes it goes towards, and measures what they changed together. The
/// portrait, read from `path`, gets one entry of history an edit. On an error it stays as it was.
pub fn apply(portrait: &mut Portrait, path: &Path, model: &Generator, edits: &[(Edit, Tensor)]) -> Result<Edited> {
    for (edit, _) in edits {
        edit.validate()?;
    }
    let mut opened = Opened::new(portrait, path, model)?;
    let camera = portrait.camera;
    let first = opened.picture(&camera)?;
    let mut before = first.clone();
    let mut history = Vec::with_capacity(edits.len());
    let mut all = RegionSet::EMPTY;
    for (edit, source) in edits {
        let undo = Undo { codes: opened.codes.squeeze(0)?, upsampler_code: portrait.upsampler_code.clone() };
        opened.codes = codes::blend(&opened.codes, source, edit.regions, edit.aspect, edit.amount)?.detach();
        let after = opened.picture(&camera)?;
        let change = measure(&before, &after, edit.regions)?;
        history.push((EditRecord { edit: edit.clone(), change }, undo));
        all = all.union(edit.regions);
        before = after;
    }
    let change = measure(&first, &before, all)?;
    let [before_picture, after_picture] = [&first.rgb, &before.rgb].map(one_picture);
    let edited = Edited {
        change,
        before: before_picture?,
        after: after_picture?,
        regions: LabelMap::from_masks(&before.masks.squeeze(0)?)?.colours(),
    };
    portrait.thumbnail =
        picture::resize(&edited.after, portrait.thumbnail.width().max(1), portrait.thumbnail.height().max(1))?;
    portrait.codes = opened.codes.squeeze(0)?;
    portrait.history.extend(history);
    Ok(edited)
}

impl Edit {
    fn validate(&self) -> Result<()> {
        const FARTHEST: f64 = 10.0;
        if self.regions.is_empty() {
            return Err(Error::config("--region", "names no region"));
        }
        if self.amount.is_nan() || self.amount.abs() > FARTHEST {
            return Err(Error::config(
                "--amount",
                format!("{} is not between -{FARTHEST} and {FARTHEST}", self.amount),
            ));
        }
        Ok(())
    }
}

/// Colour change where `regions` were or are (argmax masks, grown by a pixel: a picture's edges are a pixel wide) and
/// elsewhere, and depth change.
fn measure(before: &Picture, after: &Picture, regions: RegionSet) -> Result<Change> {
    let (old, new) =
        (LabelMap::from_masks(&before.masks.squeeze(0)?)?, LabelMap::from_masks(&after.masks.squeeze(0)?)?);
    let (width, height) = (old.width() as usize, old.height() as usize);
    let shown = |labels: &LabelMap, index: usize| {
        let region = labels.labels().get(index).copied().and_then(Region::from_label);
        region.is_some_and(|region| regions.contains(region))
    };
    let inside: Vec<bool> = (0..width * height).map(|index| shown(&old, index) || shown(&new, index)).collect();
    let grown: Vec<f32> = (0..width * height)
        .map(|index| {
            let (x, y) = (index % width, index / width);
            let mut near = (y.saturating_sub(1)..(y + 2).min(height))
                .flat_map(|row| (x.saturating_sub(1)..(x + 2).min(width)).map(move |column| row * width + column));
            f32::from(u8::from(near.any(|index| inside.get(index).copied().unwrap_or(false))))
        })
        .collect();
    let mask = Tensor::from_vec(grown, (1, 1, height, width), before.rgb.device())?;
    let [before_rgb, after_rgb] = [before.rgb.clamp(-1.0, 1.0)?, after.rgb.clamp(-1.0, 1.0)?];
    let change = quality::change(&before_rgb, &after_rgb, &mask)?.into_iter().next();
    let depth = (&before.frame.depth - &after.frame.depth)?.abs()?.mean_all()?;
    Ok(Change {
        inside_change: change.and_then(|change| change.inside).unwrap_or(0.0),
        outside_change: change.and_then(|change| change.outside).unwrap_or(0.0),
        depth_change: objective::scalar(&depth)?,
    })
}
