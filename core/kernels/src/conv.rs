//! Two-dimensional convolutions as differentiable operations: what the discriminators, the upsampler and the
//! perceptual features spend their time in.
//!
//! The three maps of a convolution `y = x ∗ w` are each linear in both of their arguments, and the gradients of any
//! one are the other two:
//!
//! | function | map | gradients |
//! | --- | --- | --- |
//! | [`conv2d`] | (x, w) → y | [`conv2d_input_gradient`], [`conv2d_weight_gradient`] |
//! | [`conv2d_input_gradient`] | (dy, w) → dx | [`conv2d`], [`conv2d_weight_gradient`] |
//! | [`conv2d_weight_gradient`] | (x, dy) → dw | [`conv2d_input_gradient`], [`conv2d`] |
//!
//! So a gradient graph that is written out explicitly (the R1 penalty of a discriminator) can itself be
//! differentiated. What a backward pass returns is not tracked for another one: candle detaches gradients anyway.
//!
//! On a CPU in f32 the maps are computed directly, by vectors of whatever instruction set the processor has; other
//! devices and types go through candle's own operations. [`bias_leaky_relu`], which follows most convolutions, is here too.

mod activation;
mod composed;
mod direct;
mod geometry;
mod plain;
mod tile;
mod weight_gradient;

#[cfg(test)]
mod tests;

use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Shape, Tensor};

use self::activation::ChannelSums;
pub use self::activation::{bias_leaky_relu, leaky_relu_gradient};
use self::geometry::Geometry;
use crate::{Error, Result};

/// The convolution (in the networks' sense, i.e. the correlation) of `input` `[B, C, H, W]` by `weight`
/// `[O, C, kh, kw]`, plus `bias` `[O]`: `[B, O, Ho, Wo]` with `Ho = ⌊(H + 2·padding − kh) / stride⌋ + 1`.
///
/// Differentiable in all three. A gradient is only computed for arguments that depend on a variable, so frozen
/// weights cost nothing.
///
/// # Errors
/// When the shapes do not fit, or the environment variable `CNERF_KERNEL` names no kernel.
pub fn conv2d(input: &Tensor, weight: &Tensor, bias: Option<&Tensor>, stride: usize, padding: usize) -> Result<Tensor> {
    let geometry = Geometry::new(input.dims(), weight.dims(), stride, padding)?;
    if let Some(bias) = bias
        && bias.dims() != [geometry.output_channels]
    {
        return Err(Error::shape("convolution bias", [geometry.output_channels], bias.dims()));
    }
    if !is_direct(&geometry, &[input, weight])? {
        return Ok(composed::forward(&geometry, input, weight, bias)?);
    }
    let convolution = Convolution { geometry, path: Path::chosen()? };
    let (input, weight) = (input.contiguous()?, weight.contiguous()?);
    Ok(match bias {
        Some(bias) => input.apply_op3(&weight, &bias.contiguous()?, convolution)?,
        None => input.apply_op2(&weight, convolution)?,
    })
}

/// The gradient of [`conv2d`] with respect to its input, which has `input_size` (rows, columns): from `grad_output`
/// `[B, O, Ho, Wo]` and `weight` `[O, C, kh, kw]` to `[B, C, H, W]`. Differentiable in both.
///
/// # Errors
/// When no convolution of that stride and padding maps the two shapes onto each other, or the environment variable
/// `CNERF_KERNEL` names no kernel.
pub fn conv2d_input_gradient(
    grad_output: &Tensor,
    weight: &Tensor,
    input_size: (usize, usize),
    stride: usize,
    padding: usize,
) -> Result<Tensor> {
    let (batch, _, _, _) = grad_output.dims4()?;
    let (_, channels, _, _) = weight.dims4()?;
    let input_shape = [batch, channels, input_size.0, input_size.1];
    let geometry = Geometry::new(&input_shape, weight.dims(), stride, padding)?;
    geometry.check_output("gradient of a convolution's output", grad_output)?;
    if !is_direct(&geometry, &[grad_output, weight])? {
        return Ok(composed::input_gradient(&geometry, grad_output, weight)?);
    }
    let gradient = InputGradient { geometry, path: Path::chosen()? };
    Ok(grad_output.contiguous()?.apply_op2(&weight.contiguous()?, gradient)?)
}

/// The gradient of [`conv2d`] with respect to its weight, whose kernel has `kernel_size` (rows, columns): from
/// `input` `[B, C, H, W]` and `grad_output` `[B, O, Ho, Wo]` to `[O, C, kh, kw]`. Differentiable in both.
///
/// # Errors
/// When no convolution of that stride and padding maps the two shapes onto each other, or the environment variable
/// `CNERF_KERNEL` names no kernel.
pub fn conv2d_weight_gradient(
    input: &Tensor,
    grad_output: &Tensor,
    kernel_size: (usize, usize),
    stride: usize,
    padding: usize,
) -> Result<Tensor> {
    let (_, input_channels, _, _) = input.dims4()?;
    let (_, output_channels, _, _) = grad_output.dims4()?;
    let weight_shape = [output_channels, input_channels, kernel_size.0, kernel_size.1];
    let geometry = Geometry::new(input.dims(), &weight_shape, stride, padding)?;
    geometry.check_output("gradient of a convolution's output", grad_output)?;
    if !is_direct(&geometry, &[input, grad_output])? {
        return Ok(composed::weight_gradient(&geometry, input, grad_output)?);
    }
    let gradient = WeightGradient { geometry, path: Path::chosen()? };
    Ok(input.contiguous()?.apply_op2(&grad_output.contiguous()?, gradient)?)
}

/// The transposed convolution of `input` `[B, C, H, W]` by `weight` `[C, O, kh, kw]`: `[B, O, Ho, Wo]` with
/// `Ho = (H − 1)·stride − 2·padding + kh + output_padding`. Differentiable in both.
///
/// With stride 2 and a 3 × 3 kernel this is StyleGAN2's upsampling convolution (before its blur).
///
/// # Errors
/// When the shapes do not fit, the result would be empty, or `output_padding` is not below `stride`.
pub fn conv_transpose2d(
    input: &Tensor,
    weight: &Tensor,
    stride: usize,
    padding: usize,
    output_padding: usize,
) -> Result<Tensor> {
    let (_, _, height, width) = input.dims4()?;
    let (_, _, kernel_height, kernel_width) = weight.dims4()?;
    let size = |size: usize, kernel: usize| {
        (size.checked_sub(1)? * stride + kernel + output_padding).checked_sub(2 * padding).filter(|&size| size > 0)
    };
    let (true, Some(rows), Some(columns)) =
        (output_padding < stride, size(height, kernel_height), size(width, kernel_width))
    else {
        let expected = format!(
            "a size that stride {stride}, padding {padding} and output padding {output_padding} leave something of"
        );
        return Err(Error::Shape { name: "transposed convolution".into(), expected, found: input.dims().to_vec() });
    };
    conv2d_input_gradient(input, weight, (rows, columns), stride, padding)
}

/// Whether the kernels of this module can do it; else candle does.
fn is_direct(geometry: &Geometry, tensors: &[&Tensor]) -> Result<bool> {
    Ok(!geometry.is_empty() && activation::is_direct(tensors)?)
}

impl Geometry {
    fn check_output(&self, name: &str, tensor: &Tensor) -> Result<()> {
        if tensor.dims() == self.output_shape() {
            return Ok(());
        }
        Err(Error::shape(name, self.output_shape(), tensor.dims()))
    }
}

/// How the maps are computed: all agree up to rounding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Path {
    /// The loops of the definition.
    Plain,
    /// Tiles of registers.
    Direct(InstructionSet),
}

/// The registers that a kernel is compiled for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum InstructionSet {
    /// Plain Rust, four lanes.
    Portable,
    /// Of aarch64, four lanes.
    Neon,
    /// AVX2 and FMA, eight lanes.
    Avx2,
    /// AVX-512F, sixteen lanes.
    Avx512,
}

impl InstructionSet {
    /// Whether this processor has it.
    fn available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => is_x86_feature_detected!("avx512f") && Self::Avx2.available(),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => std::arch::is_aarch64_feature_detected!("neon"),
            #[allow(unreachable_patterns, reason = "which sets are left depends on the architecture")]
            _ => false,
        }
    }

    /// Values in one register, and registers side by side in a product.
    fn lanes_and_vectors(self) -> (usize, usize) {
        fn of<V: tile::Registers>() -> (usize, usize) {
            (V::COUNT, V::VECTORS)
        }
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => of::<std::arch::x86_64::__m512>(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => of::<std::arch::x86_64::__m256>(),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => of::<std::arch::aarch64::float32x4_t>(),
            _ => of::<crate::simd::Portable>(),
        }
    }
}

impl Path {
    /// The counterpart of the fields' [`kernels::selected`], so that one variable chooses for both.
    fn chosen() -> Result<Self> {
        let instruction_set = match crate::selected()?.name() {
            "plain" => return Ok(Self::Plain),
            "avx512" => InstructionSet::Avx512,
            "avx2" => InstructionSet::Avx2,
            "neon" => InstructionSet::Neon,
            _ => InstructionSet::Portable,
        };
        Ok(Self::Direct(if instruction_set.available() { instruction_set } else { InstructionSet::Portable }))
    }

    fn forward(self, geometry: &Geometry, input: &[f32], weight: &[f32], bias: Option<&[f32]>) -> Vec<f32> {
        match self {
            Self::Plain => {
                let mut output = plain::forward(geometry, input, weight);
                if let Some(bias) = bias {
                    let channels = output.chunks_exact_mut(geometry.output_height * geometry.output_width);
                    for (channel, bias) in channels.zip(bias.iter().cycle()) {
                        channel.iter_mut().for_each(|value| *value += bias);
                    }
                }
                output
            }
            Self::Direct(instruction_set) => direct::forward(instruction_set, geometry, input, weight, bias),
        }
    }

    fn input_gradient(self, geometry: &Geometry, grad_output: &[f32], weight: &[f32]) -> Vec<f32> {
        match self {
            Self::Plain => plain::input_gradient(geometry, grad_output, weight),
            Self::Direct(instruction_set) => direct::input_gradient(instruction_set, geometry, grad_output, weight),
        }
    }

    fn weight_gradient(self, geometry: &Geometry, input: &[f32], grad_output: &[f32]) -> Vec<f32> {
        match self {
            Self::Plain => plain::weight_gradient(geometry, input, grad_output),
            Self::Direct(set) => weight_gradient::weight_gradient(set, geometry, input, grad_output),
        }
    }
}

/// [`conv2d`] as an operation of candle: without a bias on two tensors, with one on three.
#[derive(Clone, Copy)]
struct Convolution {
    geometry: Geometry,
    path: Path,
}

/// [`conv2d_input_gradient`] as an operation of candle.
#[derive(Clone, Copy)]
struct InputGradient {
    geometry: Geometry,
    path: Path,
}

/// [`conv2d_weight_gradient`] as an operation of candle.
#[derive(Clone, Copy)]
struct WeightGradient {
    geometry: Geometry,
    path: Path,
}

/// The three maps on tensors, for backward passes: nothing is computed for an argument that depends on no variable.
#[derive(Clone, Copy)]
struct Backward {
    geometry: Geometry,
    path: Path,
}

impl Backward {
    fn output(self, wanted_for: &Tensor, input: &Tensor, weight: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let operation = Convolution { geometry: self.geometry, path: self.path };
        wanted(wanted_for, || input.contiguous()?.apply_op2_no_bwd(&weight.contiguous()?, &operation))
    }

    fn input(self, wanted_for: &Tensor, grad_output: &Tensor, weight: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let operation = InputGradient { geometry: self.geometry, path: self.path };
        wanted(wanted_for, || grad_output.contiguous()?.apply_op2_no_bwd(&weight.contiguous()?, &operation))
    }

    fn weight(self, wanted_for: &Tensor, input: &Tensor, grad_output: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let operation = WeightGradient { geometry: self.geometry, path: self.path };
        wanted(wanted_for, || input.contiguous()?.apply_op2_no_bwd(&grad_output.contiguous()?, &operation))
    }
}

fn wanted(by: &Tensor, compute: impl FnOnce() -> candle_core::Result<Tensor>) -> candle_core::Result<Option<Tensor>> {
    if by.track_op() { compute().map(Some) } else { Ok(None) }
}

impl CustomOp2 for Convolution {
    fn name(&self) -> &'static str {
        "conv2d"
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (input, weight) = (values(input, input_layout)?, values(weight, weight_layout)?);
        let output = self.path.forward(&self.geometry, input, weight, None);
        Ok((CpuStorage::F32(output), Shape::from(self.geometry.output_shape().as_slice())))
    }

    fn bwd(
        &self,
        input: &Tensor,
        weight: &Tensor,
        _output: &Tensor,
        grad_output: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let backward = Backward { geometry: self.geometry, path: self.path };
        Ok((backward.input(input, grad_output, weight)?, backward.weight(weight, input, grad_output)?))
    }
}

impl CustomOp3 for Convolution {
    fn name(&self) -> &'static str {
        "conv2d with bias"
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (input, weight) = (values(input, input_layout)?, values(weight, weight_layout)?);
        let output = self.path.forward(&self.geometry, input, weight, Some(values(bias, bias_layout)?));
        Ok((CpuStorage::F32(output), Shape::from(self.geometry.output_shape().as_slice())))
    }

    fn bwd(
        &self,
        input: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _output: &Tensor,
        grad_output: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let backward = Backward { geometry: self.geometry, path: self.path };
        Ok((
            backward.input(input, grad_output, weight)?,
            backward.weight(weight, input, grad_output)?,
            wanted(bias, || grad_output.contiguous()?.apply_op1_no_bwd(&ChannelSums))?,
        ))
    }
}

impl CustomOp2 for InputGradient {
    fn name(&self) -> &'static str {
        "input gradient of conv2d"
    }

    fn cpu_fwd(
        &self,
        grad_output: &CpuStorage,
        grad_output_layout: &Layout,
        weight: &CpuStorage,
        weight_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (grad_output, weight) = (values(grad_output, grad_output_layout)?, values(weight, weight_layout)?);
        let input = self.path.input_gradient(&self.geometry, grad_output, weight);
        Ok((CpuStorage::F32(input), Shape::from(self.geometry.input_shape().as_slice())))
    }

    fn bwd(
        &self,
        grad_output: &Tensor,
        weight: &Tensor,
        _input: &Tensor,
        cotangent: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let backward = Backward { geometry: self.geometry, path: self.path };
        Ok((backward.output(grad_output, cotangent, weight)?, backward.weight(weight, cotangent, grad_output)?))
    }
}

impl CustomOp2 for WeightGradient {
    fn name(&self) -> &'static str {
        "weight gradient of conv2d"
    }

    fn cpu_fwd(
        &self,
        input: &CpuStorage,
        input_layout: &Layout,
        grad_output: &CpuStorage,
        grad_output_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (input, grad_output) = (values(input, input_layout)?, values(grad_output, grad_output_layout)?);
        let weight = self.path.weight_gradient(&self.geometry, input, grad_output);
        Ok((CpuStorage::F32(weight), Shape::from(self.geometry.weight_shape().as_slice())))
    }

    fn bwd(
        &self,
        input: &Tensor,
        grad_output: &Tensor,
        _weight: &Tensor,
        cotangent: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let backward = Backward { geometry: self.geometry, path: self.path };
        Ok((backward.input(input, grad_output, cotangent)?, backward.output(grad_output, input, cotangent)?))
    }
}

/// The values of a contiguous f32 tensor.
fn values<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    let (start, end) =
        layout.contiguous_offsets().ok_or_else(|| candle_core::Error::msg("a convolution needs contiguous tensors"))?;
    Ok(&storage.as_slice::<f32>()?[start..end])
}
