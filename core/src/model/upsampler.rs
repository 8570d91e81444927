//! The style-based 2D generator.
