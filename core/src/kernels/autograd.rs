//! The door to the kernels: local generators as one differentiable candle function.

use candle_core::Tensor;

use super::{HeadShape, Outputs, composed};
use crate::error::Result;

/// Evaluates every region at every point of its image, differentiable to first order in all three tensors; gradient
/// rows are differentiable too, so a loss on them is the exact double backward.
///
/// - `points` [B, N, 3] scaled to network units, or [B, N, 6] with the view direction when a head reads it;
/// - `weights` [k, P], one region a row, packed as [`HeadShape::layout`];
/// - `film` [B, k, 5, 2, W], γ then β of each layer;
/// - the result is [B, k, C, N], rows as [`HeadShape::rows`].
///
/// # Errors
/// If a tensor has another shape, or candle errs.
pub fn evaluate(
    points: &Tensor,
    weights: &Tensor,
    film: &Tensor,
    shape: HeadShape,
    outputs: Outputs,
) -> Result<Tensor> {
    composed::evaluate(points, weights, film, shape, outputs)
}
