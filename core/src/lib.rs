//! The compositional neural radiance field of portraits: nine local fields, one per region, fused by learnt masks
//! over one signed distance field, rendered and lifted to pictures; how to train it, and how to measure it.
//!
//! A floor uses only floors below it:
//! vocabulary ([`region`], [`camera`], [`codes`], [`config`], [`parameters`], [`rng`], [`files`], [`error`]) →
//! [`kernels`] → [`render`] → [`model`] → [`data`] / [`train`] / [`parsing`] → [`eval`] / [`interop`] → [`bench`].

pub mod bench;
pub mod camera;
pub mod codes;
pub mod config;
pub mod data;
pub mod error;
pub mod eval;
pub mod files;
pub mod interop;
pub mod model;
pub mod parameters;
pub mod parsing;
pub mod region;
pub mod render;
pub mod rng;
pub mod train;

pub use cnerf_kernels as kernels;
pub use error::{Error, Result};
