//! Where samples lie along rays.
