//! Measures: pixel and perceptual distances, mask agreement, how like real portraits random ones are, whether views
//! agree, locality of edits, separation of shape and texture.

pub mod consistency;
pub mod distribution;
pub mod features;
pub mod locality;
pub mod perceptual;
pub mod quality;
pub mod realism;
pub mod separation;
pub mod spectrum;
pub mod subject;
pub mod warp;
