//! From a photo to an editable 3D portrait: find and align the face, fit codes and camera (the pivot), tune the
//! generator around them, keep it all in one portrait file, and edit that.

pub mod align;
pub mod detect;
pub mod error;
pub mod photo;

pub use error::{Error, Result};
