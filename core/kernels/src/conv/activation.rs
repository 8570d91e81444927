//! Bias and leaky ReLU in one pass over memory: candle's elementwise operations are serial, and the five that this
//! takes would cost as much as the convolution before them.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, DType, Layout, Shape, Tensor};
use rayon::prelude::*;

use super::values;
use crate::{Error, Result};

/// `gain · leaky(input + bias)` with leaky(v) = v above zero and `slope · v` elsewhere, for `input` `[B, C, …]` and `bias`
/// `[C]`; differentiable in both. StyleGAN2 uses slope 0.2 and gain √2.
///
/// # Errors
/// When the shapes do not fit, or `slope` is negative or `gain` not positive (the sign of the result must be that of
/// the sum, for the gradient is told from it).
pub fn bias_leaky_relu(input: &Tensor, bias: Option<&Tensor>, slope: f64, gain: f64) -> Result<Tensor> {
    let activation = Activation::new(slope, gain)?;
    let input = match bias {
        None => input.clone(),
        Some(bias) => {
            let channels = input.dims().get(1).copied();
            if bias.dims().first().copied() != channels || bias.rank() != 1 {
                return Err(Error::shape("bias of a leaky ReLU", [channels.unwrap_or_default()], bias.dims()));
            }
            if is_direct(&[input, bias])? {
                return Ok(input.contiguous()?.apply_op2(&bias.contiguous()?, activation)?);
            }
            let mut shape = vec![1; input.rank()];
            shape[1] = bias.dim(0)?;
            input.broadcast_add(&bias.reshape(shape)?)?
        }
    };
    if is_direct(&[&input])? {
        return Ok(input.contiguous()?.apply_op1(activation)?);
    }
    Ok((&input * activation.slopes(&input)?)?)
}

/// The gradient of [`bias_leaky_relu`] with respect to its input, from its `output` and the output's gradient; both of one
/// shape. Differentiable in `grad_output` (it is linear in it), constant in `output`.
///
/// # Errors
/// When the shapes differ, or for the slopes and gains that [`bias_leaky_relu`] refuses.
pub fn leaky_relu_gradient(output: &Tensor, grad_output: &Tensor, slope: f64, gain: f64) -> Result<Tensor> {
    if output.dims() != grad_output.dims() {
        return Err(Error::shape("gradient of a leaky ReLU", output.dims(), grad_output.dims()));
    }
    let activation = Activation::new(slope, gain)?;
    let output = output.detach();
    if is_direct(&[&output, grad_output])? {
        return Ok(output.contiguous()?.apply_op2(&grad_output.contiguous()?, Gradient(activation))?);
    }
    Ok((grad_output * activation.slopes(&output)?)?)
}

/// Values that one task treats: enough to be worth a thread's attention.
const TASK: usize = 1 << 14;

/// Whether the kernels of this module can do it; else candle does.
pub(super) fn is_direct(tensors: &[&Tensor]) -> Result<bool> {
    let fits = tensors.iter().all(|tensor| tensor.device().is_cpu() && tensor.dtype() == DType::F32);
    Ok(fits && !crate::Path::is_composed()?)
}

/// A leaky ReLU that scales by `above` what is above zero, and by `below` the rest.
#[derive(Clone, Copy)]
struct Activation {
    above: f64,
    below: f64,
}

/// The activation's gradient as a map of (output, gradient of the output).
struct Gradient(Activation);

impl Activation {
    fn new(slope: f64, gain: f64) -> Result<Self> {
        if slope >= 0.0 && gain > 0.0 {
            return Ok(Self { above: gain, below: gain * slope });
        }
        Err(Error::config("leaky ReLU", format!("slope {slope} must not be negative, gain {gain} must be positive")))
    }

    /// The derivative where the input (or the output) is `at`, as a constant.
    fn slopes(&self, at: &Tensor) -> candle_core::Result<Tensor> {
        at.detach().gt(0.0)?.to_dtype(at.dtype())?.affine(self.above - self.below, self.below)
    }

    fn apply(&self, value: f32) -> f32 {
        value * if value > 0.0 { self.above as f32 } else { self.below as f32 }
    }

    fn input_gradient(&self, input: &Tensor, output: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        if !input.track_op() {
            return Ok(None);
        }
        output.contiguous()?.apply_op2_no_bwd(&grad.contiguous()?, &Gradient(*self)).map(Some)
    }
}

impl CustomOp1 for Activation {
    fn name(&self) -> &'static str {
        "leaky relu"
    }

    fn cpu_fwd(&self, input: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let output = values(input, layout)?.par_iter().with_min_len(TASK).map(|&value| self.apply(value)).collect();
        Ok((CpuStorage::F32(output), layout.shape().clone()))
    }

    fn bwd(&self, input: &Tensor, output: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        self.input_gradient(input, output, grad)
    }
}

impl CustomOp2 for Activation {
    fn name(&self) -> &'static str {
        "leaky relu with bias"
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (input, bias) = (values(input, input_layout)?, values(bias, bias_layout)?);
        let shape = input_layout.shape();
        let channel_size = shape.dims()[2..].iter().product::<usize>().max(1);
        let mut output = vec![0.0; input.len()];
        output
            .par_chunks_mut(channel_size)
            .zip(input.par_chunks(channel_size))
            .with_min_len(TASK.div_ceil(channel_size))
            .enumerate()
            .for_each(|(channel, (output, input))| {
                let bias = bias[channel % bias.len()];
                output.iter_mut().zip(input).for_each(|(output, &input)| *output = self.apply(input + bias));
            });
        Ok((CpuStorage::F32(output), shape.clone()))
    }

    fn bwd(
        &self,
        input: &Tensor,
        bias: &Tensor,
        output: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let sum = if input.track_op() { input } else { bias };
        let of_sum = self.input_gradient(sum, output, grad)?;
        let of_bias = match &of_sum {
            Some(gradient) if bias.track_op() => Some(gradient.apply_op1_no_bwd(&ChannelSums)?),
            _ => None,
        };
        Ok((of_sum.filter(|_| input.track_op()), of_bias))
    }
}

impl CustomOp2 for Gradient {
    fn name(&self) -> &'static str {
        "gradient of leaky relu"
    }

    fn cpu_fwd(
        &self,
        output: &CpuStorage,
        output_layout: &Layout,
        grad: &CpuStorage,
        grad_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (output, grad) = (values(output, output_layout)?, values(grad, grad_layout)?);
        let (above, below) = (self.0.above as f32, self.0.below as f32);
        let gradient = output
            .par_iter()
            .zip(grad)
            .with_min_len(TASK)
            .map(|(&output, &grad)| grad * if output > 0.0 { above } else { below })
            .collect();
        Ok((CpuStorage::F32(gradient), output_layout.shape().clone()))
    }

    fn bwd(
        &self,
        output: &Tensor,
        grad: &Tensor,
        _gradient: &Tensor,
        cotangent: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        Ok((None, self.0.input_gradient(grad, output, cotangent)?))
    }
}

/// `[B, C, …]` summed to `[C]`; only ever used for gradients, so without one of its own.
pub(super) struct ChannelSums;

impl CustomOp1 for ChannelSums {
    fn name(&self) -> &'static str {
        "sums of channels"
    }

    fn cpu_fwd(&self, input: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let dims = layout.shape().dims();
        let (batch, channels) = (dims[0], dims[1]);
        let sums = channel_sums(values(input, layout)?, batch, channels);
        Ok((CpuStorage::F32(sums), Shape::from(channels)))
    }
}

/// The sums of `channels` channels over `batch` images and all positions, always in the same order.
pub(super) fn channel_sums(values: &[f32], batch: usize, channels: usize) -> Vec<f32> {
    let positions = values.len() / (batch * channels).max(1);
    let of_channel = |channel: usize| {
        let mut total = 0f64;
        for image in 0..batch {
            // Sixteen short sums side by side, gathered in f64 before they grow long enough to lose digits.
            for block in values[(image * channels + channel) * positions..][..positions].chunks(4096) {
                let mut sums = [0f32; 16];
                let vectors = block.chunks_exact(16);
                total += vectors.remainder().iter().map(|&value| f64::from(value)).sum::<f64>();
                for vector in vectors {
                    sums.iter_mut().zip(vector).for_each(|(sum, value)| *sum += value);
                }
                total += sums.iter().map(|&sum| f64::from(sum)).sum::<f64>();
            }
        }
        total as f32
    };
    (0..channels).into_par_iter().map(of_channel).collect()
}
