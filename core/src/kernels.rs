//! How a field is computed on a CPU: one trait, a plain reference that anybody can read, a fused version, and the
//! candle operations that train through them.

pub mod autograd;
pub mod fused;
pub mod plain;
pub mod simd;
