//! From noise to codes.
