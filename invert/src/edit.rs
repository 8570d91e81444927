//! Edits: rows of a portrait's codes moved to another portrait's, a seed's or the mean's, and what that changed.

use cnerf_core::{codes::Aspect, region::RegionSet};
use serde::{Deserialize, Serialize};

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
