//! Losses, the trainer and its checkpoints.

pub mod adversarial;
pub mod config;
pub mod losses;
pub mod optimiser;
