//! Procedural cartoon portraits.
