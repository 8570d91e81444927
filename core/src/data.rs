//! What to learn from: label maps, datasets of photos and masks, and procedural cartoon portraits.

pub mod cartoon;
pub mod dataset;
pub mod import;
pub mod labels;
pub mod loader;
pub mod picture;
