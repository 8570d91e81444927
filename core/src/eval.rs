//! Measures: pixel and perceptual distances, mask agreement, locality of edits.

pub mod perceptual;
pub mod quality;
