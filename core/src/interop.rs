//! Other programs' files: the authors' checkpoints, meshes, animations.

pub mod animation;
pub mod mesh;
pub mod sheet;
pub mod torch;
