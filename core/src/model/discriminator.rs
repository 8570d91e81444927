//! The global, semantic and high-resolution discriminators.
