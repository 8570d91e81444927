//! Kernels as differentiable candle operations.
