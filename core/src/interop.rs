//! Other programs' files: the authors' checkpoints, meshes, animations, pages.

pub mod animation;
pub mod authors;
pub mod authors_checkpoint;
pub mod authors_nets;
pub mod chart;
pub mod mesh;
pub mod page;
pub mod sheet;
pub mod surface;
pub mod tensorboard;
pub mod torch;
