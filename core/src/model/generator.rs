//! The whole generator.
