//! Losses, the trainer and its checkpoints.

pub mod adversarial;
pub mod losses;
