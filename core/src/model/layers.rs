//! Building blocks of the 2D networks: convolutions and their adjoint, separable resampling, StyleGAN2's equalised
//! layers and activations.
//!
//! R1 and path-length penalties differentiate a gradient. Second-order autograd is neither exact nor affordable in
//! candle, so every block here has its adjoint written out in differentiable operations: a network can lay down the
//! graph of its own input gradient, and first-order autograd of that graph is exact.

use candle_core::{DType, Device, Tensor};

use crate::{
    error::Result,
    kernels::conv,
    parameters::{Init, Parameters},
};

/// `input` `[B, I, h, w]` correlated with `weight` `[O, I, k, k]`, plus `bias` `[O]`.
///
/// The one place where the 2D networks reach a convolution kernel, together with [`convolve_adjoint`].
pub fn convolve(
    input: &Tensor,
    weight: &Tensor,
    bias: Option<&Tensor>,
    stride: usize,
    padding: usize,
) -> Result<Tensor> {
    let (outputs, inputs, kernel, _) = weight.dims4()?;
    if kernel == 1 && stride == 1 && padding == 0 {
        let mixed = mix_channels(&weight.reshape((outputs, inputs))?, input)?;
        return bias.map_or_else(|| Ok(mixed.clone()), |bias| add_bias(&mixed, bias));
    }
    Ok(conv::conv2d(input, weight, bias, stride, padding)?)
}

/// The adjoint of [`convolve`]: takes the gradient `[B, O, h', w']` of its output to the gradient `[B, I, size]` of its
/// input. Differentiable in both arguments; with stride 2 it is the upsampling ("transposed") convolution.
pub fn convolve_adjoint(
    gradient: &Tensor,
    weight: &Tensor,
    stride: usize,
    padding: usize,
    size: (usize, usize),
) -> Result<Tensor> {
    let (outputs, inputs, kernel, _) = weight.dims4()?;
    if kernel == 1 && stride == 1 && padding == 0 {
        return mix_channels(&weight.reshape((outputs, inputs))?.t()?, gradient);
    }
    Ok(conv::conv2d_input_gradient(gradient, weight, size, stride, padding)?)
}

/// `[O, I]` applied to every pixel of `[B, I, h, w]`.
fn mix_channels(weight: &Tensor, input: &Tensor) -> Result<Tensor> {
    let (batch, _, height, width) = input.dims4()?;
    let (outputs, inputs) = weight.dims2()?;
    let pixels = input.reshape((batch, inputs, height * width))?;
    let mixed = weight.broadcast_as((batch, outputs, inputs))?.matmul(&pixels)?;
    Ok(mixed.reshape((batch, outputs, height, width))?)
}

/// `bias` `[C]` added to every pixel of `[B, C, h, w]`.
pub fn add_bias(input: &Tensor, bias: &Tensor) -> Result<Tensor> {
    Ok(input.broadcast_add(&bias.reshape((1, bias.elem_count(), 1, 1))?)?)
}

/// A plain convolution with bias, started like PyTorch's: weight and bias uniform in ±1/√(fan-in).
#[derive(Clone, Debug)]
pub struct Convolution {
    weight: Tensor,
    bias: Tensor,
    padding: usize,
}

impl Convolution {
    /// A `kernel`² convolution that keeps the picture's size (`kernel` odd). `gain` scales the weight's start.
    pub fn new(inputs: usize, outputs: usize, kernel: usize, gain: f64, parameters: &Parameters) -> Result<Self> {
        let bound = 1.0 / ((inputs * kernel * kernel) as f64).sqrt();
        let weight = parameters.get("weight", &[outputs, inputs, kernel, kernel], Init::Uniform(gain * bound))?;
        let bias = parameters.get("bias", &[outputs], Init::Uniform(gain * bound))?;
        Ok(Self { weight, bias, padding: kernel / 2 })
    }

    /// `[B, I, h, w]` → `[B, O, h, w]`.
    pub fn forward(&self, input: &Tensor) -> Result<Tensor> {
        convolve(input, &self.weight, Some(&self.bias), 1, self.padding)
    }
}

/// A separable linear resampling of pictures: the same small matrix along rows and columns.
///
/// Written as two matrix products: they run at the matmul's speed, their gradient is the transposed matrix, and any
/// device that has a matmul has them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Resampling {
    /// Twice the size, bilinear between pixel centres, edges repeated.
    BilinearUp,
    /// Half the size, mean of 2×2 pixels (sizes must be even).
    AverageDown,
    /// StyleGAN2's `upfirdn2d` with the kernel [1, 3, 3, 1]: zeros inserted between pixels (`up`), zeros around,
    /// filtered with the kernel's sum equal to `gain`, every `down`-th sample kept.
    Fir {
        /// Zero insertion factor.
        up: usize,
        /// Decimation factor.
        down: usize,
        /// Zeros before and after.
        padding: (usize, usize),
        /// Sum of the kernel along one axis; equal to `up` for unit brightness.
        gain: f64,
    },
}

impl Resampling {
    /// StyleGAN2's upsampling of skips: twice the size.
    pub const FIR_UP: Self = Self::Fir { up: 2, down: 1, padding: (2, 1), gain: 2.0 };
    /// The blur after a stride-2 transposed 3×3 convolution: size n + 1 → n, brightness × 2 per axis.
    pub const BLUR_AFTER_UP: Self = Self::Fir { up: 1, down: 1, padding: (1, 1), gain: 2.0 };
    /// The blur before a stride-2 3×3 convolution: size n → n + 1.
    pub const BLUR_BEFORE_DOWN: Self = Self::Fir { up: 1, down: 1, padding: (2, 2), gain: 1.0 };
    /// The blur before a stride-2 1×1 convolution, decimated at once: half the size.
    pub const FIR_DOWN: Self = Self::Fir { up: 1, down: 2, padding: (1, 1), gain: 1.0 };

    /// Resamples `[B, C, h, w]`.
    pub fn apply(self, input: &Tensor) -> Result<Tensor> {
        let (_, _, height, width) = input.dims4()?;
        let rows = self.matrix(height, input.dtype(), input.device())?;
        let columns = if width == height { rows.clone() } else { self.matrix(width, input.dtype(), input.device())? };
        multiply_rows_and_columns(input, &rows, &columns)
    }

    /// The adjoint of [`Self::apply`] on pictures of `size`: gradient of the output → gradient of the input.
    pub fn adjoint(self, gradient: &Tensor, size: (usize, usize)) -> Result<Tensor> {
        let rows = self.matrix(size.0, gradient.dtype(), gradient.device())?.t()?;
        let columns = self.matrix(size.1, gradient.dtype(), gradient.device())?.t()?;
        multiply_rows_and_columns(gradient, &rows, &columns)
    }

    /// The matrix `[output size, size]` along one axis.
    fn matrix(self, size: usize, dtype: DType, device: &Device) -> Result<Tensor> {
        let mut taps = Vec::new();
        let outputs = match self {
            Self::BilinearUp => {
                for pixel in 0..size {
                    let (before, after) = (pixel.saturating_sub(1), (pixel + 1).min(size - 1));
                    taps.extend([(2 * pixel, pixel, 0.75), (2 * pixel, before, 0.25)]);
                    taps.extend([(2 * pixel + 1, pixel, 0.75), (2 * pixel + 1, after, 0.25)]);
                }
                2 * size
            }
            Self::AverageDown => {
                taps.extend((0..size).map(|pixel| (pixel / 2, pixel, 0.5)));
                size / 2
            }
            Self::Fir { up, down, padding, gain } => {
                let outputs = (size * up + padding.0 + padding.1).saturating_sub(4) / down + 1;
                for output in 0..outputs {
                    for (tap, weight) in [1.0, 3.0, 3.0, 1.0].into_iter().enumerate() {
                        let Some(position) = (output * down + tap).checked_sub(padding.0) else { continue };
                        if position % up == 0 && position / up < size {
                            taps.push((output, position / up, gain * weight / 8.0));
                        }
                    }
                }
                outputs
            }
        };
        let mut matrix = vec![0f64; outputs * size];
        for (output, input, weight) in taps {
            if let Some(entry) = matrix.get_mut(output * size + input) {
                *entry += weight;
            }
        }
        Ok(Tensor::from_vec(matrix, (outputs, size), device)?.to_dtype(dtype)?)
    }
}

/// `rows · input · columnsᵀ` for every channel of `[B, C, h, w]`.
fn multiply_rows_and_columns(input: &Tensor, rows: &Tensor, columns: &Tensor) -> Result<Tensor> {
    let (batch, channels, height, width) = input.dims4()?;
    let (new_height, new_width) = (rows.dim(0)?, columns.dim(0)?);
    let wide = input.reshape((batch * channels * height, width))?.matmul(&columns.t()?)?;
    let planes = wide.reshape((batch * channels, height, new_width))?;
    let tall = rows.broadcast_as((batch * channels, new_height, height))?.matmul(&planes)?;
    Ok(tall.reshape((batch, channels, new_height, new_width))?)
}

/// The slope of leaky ReLU at `input`: 1 above zero, 0.2 elsewhere, as a constant of `input`'s shape.
pub fn leaky_slope(input: &Tensor) -> Result<Tensor> {
    Ok(input.detach().gt(0.0)?.to_dtype(input.dtype())?.affine(0.8, 0.2)?)
}

/// Leaky ReLU with slope 0.2.
pub fn leaky_relu(input: &Tensor) -> Result<Tensor> {
    Ok((input * leaky_slope(input)?)?)
}

/// `input` `[…, I]` divided by the root of its mean square.
pub fn pixel_norm(input: &Tensor) -> Result<Tensor> {
    let root = (input.sqr()?.mean_keepdim(candle_core::D::Minus1)? + 1e-8)?.sqrt()?;
    Ok(input.broadcast_div(&root)?)
}

/// StyleGAN2's unmodulated convolution with equalised learning rate, a bias, and leaky ReLU × √2.
#[derive(Clone, Debug)]
pub struct EqualConvolution {
    weight: Tensor,
    bias: Tensor,
}

impl EqualConvolution {
    /// A `kernel`² convolution that keeps the picture's size (`kernel` odd).
    pub fn new(inputs: usize, outputs: usize, kernel: usize, parameters: &Parameters) -> Result<Self> {
        Ok(Self {
            weight: parameters.get("weight", &[outputs, inputs, kernel, kernel], Init::Normal(1.0))?,
            bias: parameters.get("bias", &[outputs], Init::Constant(0.0))?,
        })
    }

    /// `[B, I, h, w]` → `[B, O, h, w]`.
    pub fn forward(&self, input: &Tensor) -> Result<Tensor> {
        let (_, inputs, kernel, _) = self.weight.dims4()?;
        let weight = (&self.weight / ((inputs * kernel * kernel) as f64).sqrt())?;
        let output = convolve(input, &weight, Some(&self.bias), 1, kernel / 2)?;
        Ok((leaky_relu(&output)? * std::f64::consts::SQRT_2)?)
    }
}

/// StyleGAN2's linear layer with equalised learning rate: the stored weight is scaled at run time.
#[derive(Clone, Debug)]
pub struct EqualLinear {
    weight: Tensor,
    bias: Tensor,
    rate: f64,
    activated: bool,
}

impl EqualLinear {
    /// `rate` multiplies the effective learning rate (0.01 in mapping networks); `bias` is the bias's start;
    /// `activated` adds leaky ReLU × √2.
    pub fn new(
        inputs: usize,
        outputs: usize,
        bias: f64,
        rate: f64,
        activated: bool,
        parameters: &Parameters,
    ) -> Result<Self> {
        let weight = parameters.get("weight", &[outputs, inputs], Init::Normal(1.0 / rate))?;
        let bias = parameters.get("bias", &[outputs], Init::Constant(bias))?;
        Ok(Self { weight, bias, rate, activated })
    }

    /// The weight as it acts, `[O, I]`.
    pub fn scaled_weight(&self) -> Result<Tensor> {
        let scale = self.rate / (self.weight.dim(1)? as f64).sqrt();
        Ok((&self.weight * scale)?)
    }

    /// `[…, I]` → `[…, O]`.
    pub fn forward(&self, input: &Tensor) -> Result<Tensor> {
        Ok(self.forward_with_slope(input)?.0)
    }

    /// As [`Self::forward`], with the activation's slope, which is what the adjoint needs.
    pub fn forward_with_slope(&self, input: &Tensor) -> Result<(Tensor, Option<Tensor>)> {
        let output = linear(input, &self.scaled_weight()?)?.broadcast_add(&(&self.bias * self.rate)?)?;
        if !self.activated {
            return Ok((output, None));
        }
        let slope = (leaky_slope(&output)? * std::f64::consts::SQRT_2)?;
        Ok(((output * &slope)?, Some(slope)))
    }
}

/// `input` `[…, I]` times `weight` `[O, I]` transposed.
pub fn linear(input: &Tensor, weight: &Tensor) -> Result<Tensor> {
    let mut shape = input.dims().to_vec();
    let inputs = shape.pop().unwrap_or(1);
    shape.push(weight.dim(0)?);
    Ok(input.reshape(((), inputs))?.matmul(&weight.t()?)?.reshape(shape)?)
}

/// PixelNorm and equalised linear layers at 1 % of the learning rate: from a field's code to an upsampler's style.
#[derive(Clone, Debug)]
pub struct StyleNetwork {
    layers: Vec<EqualLinear>,
}

impl StyleNetwork {
    /// The authors' decoder uses 5 layers; with none the network is the identity.
    pub fn new(inputs: usize, outputs: usize, layers: usize, parameters: &Parameters) -> Result<Self> {
        let layer = |index: usize| {
            let inputs = if index == 0 { inputs } else { outputs };
            EqualLinear::new(inputs, outputs, 0.0, 0.01, true, &parameters.within(index))
        };
        Ok(Self { layers: (0..layers).map(layer).collect::<Result<_>>()? })
    }

    /// `[…, I]` → `[…, O]`.
    pub fn forward(&self, code: &Tensor) -> Result<Tensor> {
        if self.layers.is_empty() {
            return Ok(code.clone());
        }
        self.layers.iter().try_fold(pixel_norm(code)?, |hidden, layer| layer.forward(&hidden))
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Var;

    use super::*;
    use crate::rng::Stream;

    fn random(seed: u64, shape: &[usize]) -> Tensor {
        Stream::new(seed, &[]).normal_tensor(shape, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
    }

    fn dot(left: &Tensor, right: &Tensor) -> f64 {
        (left * right).unwrap().sum_all().unwrap().to_scalar().unwrap()
    }

    const ALL: [Resampling; 6] = [
        Resampling::BilinearUp,
        Resampling::AverageDown,
        Resampling::FIR_UP,
        Resampling::FIR_DOWN,
        Resampling::BLUR_AFTER_UP,
        Resampling::BLUR_BEFORE_DOWN,
    ];

    #[test]
    fn resamplings_have_the_sizes_they_promise() {
        for (resampling, expected) in ALL.into_iter().zip([16, 4, 16, 4, 7, 9]) {
            let output = resampling.apply(&random(1, &[1, 2, 8, 6])).unwrap();
            assert_eq!(output.dims()[2], expected, "{resampling:?}");
        }
    }

    #[test]
    fn bilinear_upsampling_keeps_constants_and_interpolates_ramps() {
        let ramp: Vec<f64> = (0..8).map(f64::from).collect();
        let ramp = Tensor::from_vec(ramp, (1, 1, 1, 8), &Device::Cpu).unwrap();
        let up = Resampling::BilinearUp.apply(&ramp).unwrap().get_on_dim(2, 1).unwrap().flatten_all().unwrap();
        let up = up.to_vec1::<f64>().unwrap();
        assert_eq!(up[0], 0.0);
        assert_eq!(up[15], 7.0);
        assert!((1..15).all(|i| (up[i] - (i as f64 / 2.0 - 0.25)).abs() < 1e-12), "{up:?}");
    }

    #[test]
    fn adjoints_are_adjoint_and_match_autograd() {
        for resampling in ALL {
            let input = Var::from_tensor(&random(2, &[2, 3, 8, 6])).unwrap();
            let output = resampling.apply(&input).unwrap();
            let gradient = random(3, output.dims());
            let adjoint = resampling.adjoint(&gradient, (8, 6)).unwrap();
            assert!((dot(&output, &gradient) - dot(&input, &adjoint)).abs() < 1e-10);
            let automatic = (output * &gradient).unwrap().sum_all().unwrap().backward().unwrap();
            let automatic = automatic.get(&input).unwrap();
            assert!(dot(&(automatic - &adjoint).unwrap(), &(automatic - &adjoint).unwrap()) < 1e-20);
        }
        for (kernel, stride, padding, size) in [(3, 1, 1, 8), (3, 2, 0, 9), (1, 1, 0, 8), (2, 1, 0, 4), (3, 2, 0, 8)] {
            let (input, weight) = (random(4, &[2, 3, size, size]), random(5, &[4, 3, kernel, kernel]));
            let output = convolve(&input, &weight, None, stride, padding).unwrap();
            let gradient = random(6, output.dims());
            let adjoint = convolve_adjoint(&gradient, &weight, stride, padding, (size, size)).unwrap();
            assert_eq!(adjoint.dims(), input.dims());
            let difference = dot(&output, &gradient) - dot(&input, &adjoint);
            assert!(difference.abs() < 1e-9, "kernel {kernel} stride {stride}: {difference}");
        }
    }
}
