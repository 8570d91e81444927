//! Rays to pictures over any field: a small trait here (points to distance, masks, colour, features), so that
//! rendering never knows a model.

pub mod frame;
pub mod integrate;
pub mod sampling;
