//! From a photo to an editable 3D portrait: find and align the face, fit codes and camera (the pivot), tune the
//! generator around them, keep it all in one portrait file, and edit that.

pub mod align;
pub mod checkpoint;
pub mod config;
pub mod detect;
pub mod edit;
pub mod error;
pub mod evaluation;
pub mod events;
#[cfg(feature = "onnx")]
pub mod features;
mod focus;
#[cfg(test)]
mod fuzz;
pub mod inverter;
pub mod likeness;
pub mod objective;
pub mod parser;
pub mod photo;
pub mod pivot;
pub mod portrait;
pub mod space;
pub mod start;
pub mod tune;

pub use error::{Error, Result};
