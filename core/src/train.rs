//! Losses, the trainer and its checkpoints.

pub mod adversarial;
pub mod augment;
pub mod average;
pub mod checkpoint;
pub mod config;
pub mod estimate;
pub mod events;
pub mod field_stage;
pub mod losses;
pub mod optimiser;
pub mod people;
pub mod portrait_codes;
pub mod preview;
pub mod team;
#[cfg(test)]
mod test_data;
pub mod trainer;
pub mod upsampler_stage;
pub mod warmup;
pub mod whiten;
