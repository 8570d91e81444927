//! Edits: rows of a portrait's codes moved to another portrait's, a seed's, the mean's, along a direction, or to where
//! a painted map or a colour asks for; and what that changed.

mod colour;
mod directions;
mod displacement;
mod paint;

use std::path::Path;

use candle_core::{DType, Tensor};
use cnerf_core::{
    camera::Camera,
    codes::{self, Aspect},
    data::{labels::LabelMap, picture},
    eval::locality::EditChange,
    model::generator::{Generator, Picture},
    region::{REGION_COUNT, Region, RegionSet},
    render::plan::FrameReport,
};
use image::RgbImage;
use serde::{Deserialize, Serialize};

pub use self::{
    colour::{Colour, mean_colour, perceived_difference},
    directions::{directions, preview},
    paint::read_map,
};
use crate::{
    error::{Error, Result},
    inverter::{Opened, one_picture},
    portrait::{EditRecord, LARGEST_TINT, Portrait, Undo},
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
    /// A repainted region map, by the name it was given.
    Painted(String),
    /// A colour.
    Colour(Colour),
    /// A principal direction of the regions' codes, counted from 1; an amount of 1 is a standard deviation.
    Direction(usize),
}

/// A [`Source`] that is at hand.
#[derive(Clone, Debug)]
pub enum Goal {
    /// Codes `[1, 9, 2, D]`, and the tint `[9, 3]` that goes with their textures, if any.
    Codes(Tensor, Option<Tensor>),
    /// A region map of the portrait's own view, repainted.
    Painted(LabelMap),
    /// The regions' mean colour is to be this.
    Colour(Colour),
    /// See [`Source::Direction`].
    Direction(usize),
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
    /// How far the last [`Goal::Colour`]'s region ended from its colour, see [`perceived_difference`].
    pub colour_difference: Option<f64>,
    /// How the last picture was rendered, what it had in common with the one before left alone; none if it was rendered
    /// whole.
    pub rerendered: Option<FrameReport>,
}

impl Goal {
    /// What `source` means for `model`. `other` is the portrait a [`Source::Portrait`] names, which must belong to the
    /// same model; `map` is the map a [`Source::Painted`] names.
    pub fn of(source: &Source, model: &Generator, other: Option<&Portrait>, map: Option<LabelMap>) -> Result<Self> {
        let unread = |name: &str| Error::config("edit", format!("{name} was not read"));
        Ok(match source {
            Source::Seed(seed) => Self::Codes(model.codes_from_seed(*seed, 1.0)?, None),
            Source::Mean => Self::Codes(model.mean_codes()?, None),
            Source::Portrait(name) => {
                let portrait = other.ok_or_else(|| unread(name))?;
                Self::Codes(portrait.codes.unsqueeze(0)?.to_device(&model.device())?, portrait.tint.clone())
            }
            Source::Painted(name) => Self::Painted(map.ok_or_else(|| unread(name))?),
            Source::Colour(colour) => Self::Colour(*colour),
            Source::Direction(number) => Self::Direction(*number),
        })
    }

    /// What an edit of `opened`, whose tint is `tint`, goes towards.
    fn resolve(&self, opened: &Opened, tint: &Tensor, camera: &Camera, edit: &Edit) -> Result<Destination> {
        let regions = edit.regions;
        let (codes, regions) = match self {
            Self::Codes(codes, other) => {
                let tint = match other {
                    Some(other) => other.to_device(tint.device())?,
                    None => tint.zeros_like()?,
                };
                return Ok(Destination { codes: codes.clone(), tint, regions });
            }
            Self::Direction(number) => {
                let rows = directions(&opened.generator, regions, edit.aspect, *number)?;
                let direction = rows.narrow(0, number.saturating_sub(1), 1)?;
                (opened.codes.broadcast_add(&direction)?, regions)
            }
            Self::Painted(map) => {
                let shown = opened.picture(camera)?.masks;
                let shown = LabelMap::from_masks(&shown.squeeze(0)?)?;
                let map = map.resized(shown.width(), shown.height())?;
                let regions = if regions.is_empty() { paint::repainted(&shown, &map) } else { regions };
                if regions.is_empty() {
                    return Err(Error::config("--mask-paint", "the map changes no region; repaint some of it"));
                }
                (paint::codes(opened, camera, &map, regions)?, regions)
            }
            Self::Colour(colour) => {
                let (mut found, mut tint) = (opened.clone(), tint.clone());
                for region in regions.iter() {
                    found.codes = colour::codes(&found, camera, region, *colour)?;
                    tint = colour::tint(&found, &tint, camera, region, *colour)?;
                }
                return Ok(Destination { codes: found.codes, tint, regions });
            }
        };
        Ok(Destination { codes, tint: tint.clone(), regions })
    }
}

/// What an edit goes towards.
struct Destination {
    /// `[1, 9, 2, D]`.
    codes: Tensor,
    /// `[9, 3]`.
    tint: Tensor,
    /// The regions it is about: those named, or those a map changes where none is named.
    regions: RegionSet,
}

/// `own` `[9, 3]` moved towards `other` in the regions whose textures an edit changes.
fn blended_tint(own: &Tensor, other: &Tensor, edit: &Edit) -> Result<Tensor> {
    let rows = Region::ALL.map(|region| f32::from(u8::from(edit.aspect.covers(1) && edit.regions.contains(region))));
    let rows = Tensor::new(&rows, own.device())?.unsqueeze(1)?;
    let moved = ((other - own)? * edit.amount)?.broadcast_mul(&rows)?;
    Ok((own + moved)?.clamp(-LARGEST_TINT, LARGEST_TINT)?)
}

/// Applies edits in order, each with what it goes towards, and measures what they changed together. The portrait, read
/// from `path`, gets one entry of history an edit. On an error it stays as it was.
pub fn apply(portrait: &mut Portrait, path: &Path, model: &Generator, edits: &[(Edit, Goal)]) -> Result<Edited> {
    for (edit, _) in edits {
        edit.validate()?;
    }
    let mut opened = Opened::new(portrait, path, model)?;
    let camera = portrait.camera;
    let mut session = opened.session(&camera)?;
    let (first, _) = opened.picture_in(&mut session)?;
    let mut before = first.clone();
    let mut rerendered = None;
    let mut history = Vec::with_capacity(edits.len());
    let mut all = RegionSet::EMPTY;
    let mut colour_difference = None;
    let mut kept_tint = portrait.tint.clone();
    for (edit, goal) in edits {
        let tint = match &kept_tint {
            Some(tint) => tint.to_device(&model.device())?,
            None => Tensor::zeros((REGION_COUNT, 3), DType::F32, &model.device())?,
        };
        let Destination { codes: source, tint: other, regions } = goal.resolve(&opened, &tint, &camera, edit)?;
        let edit = Edit { regions, ..edit.clone() };
        let undo = Undo {
            codes: opened.codes.squeeze(0)?,
            upsampler_code: portrait.upsampler_code.clone(),
            tint: kept_tint.take(),
        };
        opened.codes = codes::blend(&opened.codes, &source, edit.regions, edit.aspect, edit.amount)?.detach();
        let tint = blended_tint(&tint, &other, &edit)?;
        opened.set_tint(&tint)?;
        kept_tint = (tint.abs()?.sum_all()?.to_scalar::<f32>()? > 0.0).then_some(tint);
        let (after, report) = opened.picture_in(&mut session)?;
        rerendered = Some(report);
        let change = measure(&before, &after, edit.regions)?;
        if let Goal::Colour(colour) = goal {
            colour_difference = farthest_from(*colour, &opened, &camera, regions)?;
        }
        history.push((EditRecord { edit, change }, undo));
        all = all.union(regions);
        before = after;
    }
    let edited = Edited { colour_difference, rerendered, ..compare(&first, &before, all)? };
    portrait.thumbnail = thumbnail(portrait, &edited.after)?;
    portrait.codes = opened.codes.squeeze(0)?;
    portrait.tint = kept_tint;
    portrait.history.extend(history);
    Ok(edited)
}

/// The region map of the portrait, read from `path`, in its own view: what a user repaints.
pub fn own_map(portrait: &Portrait, path: &Path, model: &Generator) -> Result<LabelMap> {
    let picture = Opened::new(portrait, path, model)?.picture(&portrait.camera)?;
    Ok(LabelMap::from_masks(&picture.masks.squeeze(0)?)?)
}

/// Takes back the last edit of the portrait read from `path`, thumbnail included, and says what that changed.
///
/// # Errors
/// [`Error::NothingToUndo`], and those of opening the portrait.
pub fn undo(portrait: &mut Portrait, path: &Path, model: &Generator) -> Result<(EditRecord, Edited)> {
    let camera = portrait.camera;
    let before = Opened::new(portrait, path, model)?.picture(&camera)?;
    let mut restored = portrait.clone();
    let record = restored.undo(path)?;
    let after = Opened::new(&restored, path, model)?.picture(&camera)?;
    let edited = compare(&before, &after, record.edit.regions)?;
    restored.thumbnail = thumbnail(&restored, &edited.after)?;
    *portrait = restored;
    Ok((record, edited))
}

/// What became of the first picture in the second, in which `regions` were edited.
fn compare(before: &Picture, after: &Picture, regions: RegionSet) -> Result<Edited> {
    Ok(Edited {
        change: measure(before, after, regions)?,
        before: one_picture(&before.rgb)?,
        after: one_picture(&after.rgb)?,
        regions: LabelMap::from_masks(&after.masks.squeeze(0)?)?.colours(),
        colour_difference: None,
        rerendered: None,
    })
}

/// A picture at the size of the portrait's thumbnail.
fn thumbnail(portrait: &Portrait, picture: &RgbImage) -> Result<RgbImage> {
    let (width, height) = portrait.thumbnail.dimensions();
    Ok(picture::resize(picture, width.max(1), height.max(1))?)
}

/// The largest perceived difference of the regions' mean colours from `colour`; none if none of them shows.
fn farthest_from(colour: Colour, opened: &Opened, camera: &Camera, regions: RegionSet) -> Result<Option<f64>> {
    let wanted = colour.0.map(|value| f64::from(value) / 127.5 - 1.0);
    let mut farthest: Option<f64> = None;
    for region in regions.iter() {
        if let Some(mean) = mean_colour(opened, camera, region)? {
            let difference = perceived_difference(mean, wanted)?;
            farthest = Some(farthest.map_or(difference, |farthest| farthest.max(difference)));
        }
    }
    Ok(farthest)
}

impl Edit {
    fn validate(&self) -> Result<()> {
        const FARTHEST: f64 = 10.0;
        // A painted map says which regions it changes.
        if self.regions.is_empty() && !matches!(self.source, Source::Painted(_)) {
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
    let change = EditChange::between(before, after, regions)?;
    Ok(Change {
        inside_change: change.inside.unwrap_or(0.0),
        outside_change: change.outside.unwrap_or(0.0),
        depth_change: change.depth,
    })
}
