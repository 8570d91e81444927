//! Animations and frames.
