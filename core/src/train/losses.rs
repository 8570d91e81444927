//! Losses on the field and its renders.
