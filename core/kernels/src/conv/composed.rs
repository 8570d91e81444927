//! The three maps of a convolution in candle's own operations, for the devices and types that have no kernel here.
//!
//! candle 0.11's gradients are wrong in shape where the last step of the convolution leaves rows and columns over in
//! different numbers, so what is left over is cut off first, and padding is made explicit.

use candle_core::{Result, Tensor};

use super::geometry::Geometry;

/// See [`super::conv2d`].
pub(super) fn forward(geometry: &Geometry, input: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let output = if geometry.left_over() == [0, 0] {
        input.conv2d(weight, geometry.padding, geometry.stride, 1, 1)?
    } else {
        reached(geometry, input)?.conv2d(weight, 0, geometry.stride, 1, 1)?
    };
    match bias {
        Some(bias) => output.broadcast_add(&bias.reshape((1, (), 1, 1))?),
        None => Ok(output),
    }
}

/// See [`super::conv2d_input_gradient`].
pub(super) fn input_gradient(geometry: &Geometry, grad_output: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let [rows, columns] = geometry.left_over();
    if [rows, columns] == [0, 0] {
        return grad_output.conv_transpose2d(weight, geometry.padding, 0, geometry.stride, 1);
    }
    grad_output
        .conv_transpose2d(weight, 0, 0, geometry.stride, 1)?
        .pad_with_zeros(2, 0, rows)?
        .pad_with_zeros(3, 0, columns)?
        .narrow(2, geometry.padding, geometry.input_height)?
        .narrow(3, geometry.padding, geometry.input_width)?
        .contiguous()
}

/// See [`super::conv2d_weight_gradient`]: the same sum read as a convolution over the images of the batch, in which
/// strides become dilations.
pub(super) fn weight_gradient(geometry: &Geometry, input: &Tensor, grad_output: &Tensor) -> Result<Tensor> {
    let input = reached(geometry, input)?.transpose(0, 1)?.contiguous()?;
    let grad_output = grad_output.transpose(0, 1)?.contiguous()?;
    input.conv2d(&grad_output, 0, 1, geometry.stride, 1)?.transpose(0, 1)?.contiguous()
}

/// The padded input without the rows and columns that no tap meets.
fn reached(geometry: &Geometry, input: &Tensor) -> Result<Tensor> {
    let padding = geometry.padding;
    let [rows, columns] = geometry.left_over();
    input
        .pad_with_zeros(2, padding, padding)?
        .pad_with_zeros(3, padding, padding)?
        .narrow(2, 0, geometry.input_height + 2 * padding - rows)?
        .narrow(3, 0, geometry.input_width + 2 * padding - columns)?
        .contiguous()
}
