//! The generator, its discriminators, and the files they live in.

pub mod discriminator;
pub mod field;
pub mod file;
pub mod generator;
pub mod layers;
pub mod mapping;
pub mod population;
pub mod upsampler;
