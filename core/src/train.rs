//! Losses, the trainer and its checkpoints.

pub mod adversarial;
pub mod checkpoint;
pub mod config;
pub mod events;
pub mod losses;
pub mod optimiser;
