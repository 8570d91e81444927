//! The reference: the three bilinear maps of a convolution as the loops of their definitions, for f32 and f64.
//! Slow on purpose; what the vectorised paths are compared to.

use std::ops::{AddAssign, Mul};

use super::geometry::Geometry;

/// A number that sums of products can be taken of.
pub(super) trait Number: Copy + Default + AddAssign + Mul<Output = Self> {}

impl<T: Copy + Default + AddAssign + Mul<Output = T>> Number for T {}

/// `output[b, o, y, x] = Σ weight[o, c, ky, kx] · input[b, c, s·y + ky − p, s·x + kx − p]`.
pub(super) fn forward<T: Number>(geometry: &Geometry, input: &[T], weight: &[T]) -> Vec<T> {
    let mut output = vec![T::default(); geometry.batch * geometry.output_size()];
    for_each_product(geometry, |at| output[at.output] += weight[at.weight] * input[at.input]);
    output
}

/// The adjoint of [`forward`] in its input.
pub(super) fn input_gradient<T: Number>(geometry: &Geometry, grad_output: &[T], weight: &[T]) -> Vec<T> {
    let mut input = vec![T::default(); geometry.batch * geometry.input_size()];
    for_each_product(geometry, |at| input[at.input] += weight[at.weight] * grad_output[at.output]);
    input
}

/// The adjoint of [`forward`] in its weight.
pub(super) fn weight_gradient<T: Number>(geometry: &Geometry, input: &[T], grad_output: &[T]) -> Vec<T> {
    let mut weight = vec![T::default(); geometry.weight_shape().iter().product()];
    for_each_product(geometry, |at| weight[at.weight] += input[at.input] * grad_output[at.output]);
    weight
}

/// Flat indices of the three values that meet in one product of a convolution.
struct Meeting {
    input: usize,
    weight: usize,
    output: usize,
}

fn for_each_product(g: &Geometry, mut visit: impl FnMut(Meeting)) {
    let inside = |position: usize, tap: usize, size: usize| {
        (position * g.stride + tap).checked_sub(g.padding).filter(|&at| at < size)
    };
    for b in 0..g.batch {
        for o in 0..g.output_channels {
            for y in 0..g.output_height {
                for x in 0..g.output_width {
                    let output = ((b * g.output_channels + o) * g.output_height + y) * g.output_width + x;
                    for c in 0..g.input_channels {
                        for ky in 0..g.kernel_height {
                            let Some(row) = inside(y, ky, g.input_height) else { continue };
                            for kx in 0..g.kernel_width {
                                let Some(column) = inside(x, kx, g.input_width) else { continue };
                                let input =
                                    ((b * g.input_channels + c) * g.input_height + row) * g.input_width + column;
                                let weight = ((o * g.input_channels + c) * g.kernel_height + ky) * g.kernel_width + kx;
                                visit(Meeting { input, weight, output });
                            }
                        }
                    }
                }
            }
        }
    }
}
