//! Layers of the discriminators. A forward pass pushes every layer's adjoint on a [`Tape`]; running the tape backward
//! lays down the input gradient as an ordinary differentiable graph.

use candle_core::{DType, Device, Tensor};

use crate::{
    error::Result,
    model::layers::{EqualLinear, Resampling, convolve, convolve_adjoint, leaky_slope, linear},
    parameters::{Init, Parameters},
};

type Step<'a> = Box<dyn Fn(&Tensor) -> Result<Tensor> + 'a>;

/// The adjoints of the layers a pass went through, in its order.
#[derive(Default)]
pub(super) struct Tape<'a>(Vec<Step<'a>>);

impl<'a> Tape<'a> {
    /// Adds a layer's adjoint: gradient of its output → gradient of its input.
    pub fn push(&mut self, step: impl Fn(&Tensor) -> Result<Tensor> + 'a) {
        self.0.push(Box::new(step));
    }

    /// The gradient of the first layer's input, given that of the last one's output.
    pub fn run(&self, gradient: &Tensor) -> Result<Tensor> {
        self.0.iter().rev().try_fold(gradient.clone(), |gradient, step| step(&gradient))
    }
}

/// Which of the authors' two families of layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Family {
    /// Global and semantic: ordinary convolutions, 3×3 ones also see the pixel's coordinates; average pooling.
    Coordinates,
    /// High resolution: equalised convolutions, FIR blur before decimation, activations scaled by √2.
    StyleGan2,
}

/// Sizes of a convolution.
#[derive(Clone, Copy, Debug)]
pub(super) struct LayerShape {
    pub inputs: usize,
    pub outputs: usize,
    pub kernel: usize,
    pub padding: usize,
    pub activated: bool,
    pub biased: bool,
    pub coordinates: bool,
    pub halving: bool,
}

impl LayerShape {
    /// Convolution, bias and leaky ReLU.
    pub fn activated(inputs: usize, outputs: usize, kernel: usize) -> Self {
        let padding = kernel / 2;
        Self { inputs, outputs, kernel, padding, activated: true, biased: true, coordinates: false, halving: false }
    }

    /// Convolution and bias.
    pub fn linear(inputs: usize, outputs: usize, kernel: usize) -> Self {
        Self { activated: false, ..Self::activated(inputs, outputs, kernel) }
    }
}

/// A convolution with what comes right before and after it.
#[derive(Clone, Debug)]
pub(super) struct Layer {
    weight: Tensor,
    bias: Option<Tensor>,
    /// Factor on the stored weight.
    scale: f64,
    /// Factor on the activation; none for a linear layer.
    gain: Option<f64>,
    shape: LayerShape,
}

impl Layer {
    pub fn new(family: Family, shape: LayerShape, parameters: &Parameters) -> Result<Self> {
        let LayerShape { inputs, outputs, kernel, .. } = shape;
        let inputs_with_coordinates = inputs + if shape.coordinates { 2 } else { 0 };
        let fan_in = |inputs: usize| 1.0 / ((inputs * kernel * kernel) as f64).sqrt();
        let (weight_init, bias_init, scale, gain) = match family {
            Family::Coordinates => {
                (Init::Uniform(fan_in(inputs_with_coordinates)), Init::Uniform(fan_in(inputs)), 1.0, 1.0)
            }
            Family::StyleGan2 => (Init::Normal(1.0), Init::Constant(0.0), fan_in(inputs), std::f64::consts::SQRT_2),
        };
        Ok(Self {
            weight: parameters.get("weight", &[outputs, inputs_with_coordinates, kernel, kernel], weight_init)?,
            bias: shape.biased.then(|| parameters.get("bias", &[outputs], bias_init)).transpose()?,
            scale,
            gain: shape.activated.then_some(gain),
            shape,
        })
    }

    pub fn forward<'a>(&'a self, input: &Tensor, tape: &mut Tape<'a>) -> Result<Tensor> {
        let LayerShape { inputs, padding, halving, kernel, .. } = self.shape;
        let mut input = input.clone();
        let mut stride = 1;
        if halving {
            // A 1×1 convolution may follow the decimation; a 3×3 one has to do it itself.
            let blur = if kernel == 1 { Resampling::FIR_DOWN } else { Resampling::BLUR_BEFORE_DOWN };
            stride = if kernel == 1 { 1 } else { 2 };
            input = resample(blur, &input, tape)?;
        }
        let (_, _, height, width) = input.dims4()?;
        let weight = (&self.weight * self.scale)?;
        let seen = if self.shape.coordinates { weight.narrow(1, 0, inputs)?.contiguous()? } else { weight.clone() };
        let mut output = if self.shape.coordinates {
            // The coordinates are the same for all pictures: their share is computed once.
            let coordinates = coordinates(height, width, input.dtype(), input.device())?;
            let weight = weight.narrow(1, inputs, 2)?.contiguous()?;
            let share = convolve(&coordinates, &weight, self.bias.as_ref(), stride, padding)?;
            convolve(&input, &seen, None, stride, padding)?.broadcast_add(&share)?
        } else {
            convolve(&input, &seen, self.bias.as_ref(), stride, padding)?
        };
        tape.push(move |gradient| convolve_adjoint(gradient, &seen, stride, padding, (height, width)));
        if let Some(gain) = self.gain {
            let slope = (leaky_slope(&output)? * gain)?;
            output = (output * &slope)?;
            tape.push(move |gradient| Ok((gradient * &slope)?));
        }
        Ok(output)
    }
}

/// (two convolutions, halved + skip, halved) / √2.
#[derive(Clone, Debug)]
pub(super) struct ResidualBlock {
    family: Family,
    first: Layer,
    second: Layer,
    skip: Option<Layer>,
}

impl ResidualBlock {
    pub fn new(family: Family, inputs: usize, outputs: usize, parameters: &Parameters) -> Result<Self> {
        let (first, second, skip) = match family {
            Family::Coordinates => {
                let seeing = |inputs| LayerShape { coordinates: true, ..LayerShape::activated(inputs, outputs, 3) };
                let skip = (inputs != outputs).then(|| LayerShape::linear(inputs, outputs, 1));
                (seeing(inputs), seeing(outputs), skip)
            }
            Family::StyleGan2 => {
                let second = LayerShape { halving: true, padding: 0, ..LayerShape::activated(inputs, outputs, 3) };
                let skip = LayerShape { halving: true, biased: false, ..LayerShape::linear(inputs, outputs, 1) };
                (LayerShape::activated(inputs, inputs, 3), second, Some(skip))
            }
        };
        Ok(Self {
            family,
            first: Layer::new(family, first, &parameters.within("first"))?,
            second: Layer::new(family, second, &parameters.within("second"))?,
            skip: skip.map(|shape| Layer::new(family, shape, &parameters.within("skip"))).transpose()?,
        })
    }

    pub fn forward<'a>(&'a self, input: &Tensor, tape: &mut Tape<'a>) -> Result<Tensor> {
        let (mut main_tape, mut skip_tape) = (Tape::default(), Tape::default());
        let mut main = self.first.forward(input, &mut main_tape)?;
        main = self.second.forward(&main, &mut main_tape)?;
        let mut skip = input.clone();
        if self.family == Family::Coordinates {
            main = resample(Resampling::AverageDown, &main, &mut main_tape)?;
            skip = resample(Resampling::AverageDown, &skip, &mut skip_tape)?;
        }
        if let Some(layer) = &self.skip {
            skip = layer.forward(&skip, &mut skip_tape)?;
        }
        tape.push(move |gradient| {
            let gradient = (gradient * std::f64::consts::FRAC_1_SQRT_2)?;
            Ok((main_tape.run(&gradient)? + skip_tape.run(&gradient)?)?)
        });
        Ok(((main + skip)? * std::f64::consts::FRAC_1_SQRT_2)?)
    }
}

/// Linear layers one after the other.
pub(super) fn linears<'a>(layers: &'a [EqualLinear], input: &Tensor, tape: &mut Tape<'a>) -> Result<Tensor> {
    layers.iter().try_fold(input.clone(), |hidden, layer| {
        let (output, slope) = layer.forward_with_slope(&hidden)?;
        tape.push(move |gradient| {
            let gradient = slope.as_ref().map_or_else(|| Ok(gradient.clone()), |slope| gradient * slope)?;
            linear(&gradient, &layer.scaled_weight()?.t()?)
        });
        Ok(output)
    })
}

/// Adds a channel with the standard deviation of the features over groups of up to four pictures, averaged over
/// channels and pixels: it tells a batch of look-alikes from a varied one.
pub(super) fn minibatch_deviation(input: &Tensor, tape: &mut Tape<'_>) -> Result<Tensor> {
    let (batch, channels, height, width) = input.dims4()?;
    // Largest divisor of up to 4: the authors' choice wherever theirs works.
    let group = (1..=batch.min(4)).rev().find(|size| batch.is_multiple_of(*size)).unwrap_or(1);
    let groups = batch / group;
    let grouped = input.reshape((group, groups, channels, height, width))?;
    let centred = grouped.broadcast_sub(&grouped.mean_keepdim(0)?)?;
    let deviation = (centred.sqr()?.mean_keepdim(0)? + 1e-8)?.sqrt()?;
    let statistic = deviation.reshape((groups, channels * height * width))?.mean(1)?;
    let channel = statistic
        .reshape((1, groups, 1, 1, 1))?
        .broadcast_as((group, groups, 1, height, width))?
        .reshape((batch, 1, height, width))?;
    tape.push(move |gradient| {
        let direct = gradient.narrow(1, 0, channels)?;
        // The mean's share of the derivative cancels: the centred values of a group sum to zero.
        let statistic_gradient =
            gradient.narrow(1, channels, 1)?.reshape((group, groups, height * width))?.sum(2)?.sum(0)?;
        let factor = (statistic_gradient / (channels * height * width * group) as f64)?;
        let slope = centred.broadcast_div(&deviation)?.broadcast_mul(&factor.reshape((1, groups, 1, 1, 1))?)?;
        Ok((direct + slope.reshape((batch, channels, height, width))?)?)
    });
    Ok(Tensor::cat(&[input, &channel], 1)?)
}

fn resample(resampling: Resampling, input: &Tensor, tape: &mut Tape<'_>) -> Result<Tensor> {
    let (_, _, height, width) = input.dims4()?;
    tape.push(move |gradient| resampling.adjoint(gradient, (height, width)));
    resampling.apply(input)
}

/// Row and column of every pixel in [−1, 1], `[1, 2, h, w]`.
fn coordinates(height: usize, width: usize, dtype: DType, device: &Device) -> Result<Tensor> {
    let ramp = |size: usize| -> Result<Tensor> {
        let last = size.saturating_sub(1).max(1) as f64;
        let values: Vec<f64> = (0..size).map(|index| 2.0 * index as f64 / last - 1.0).collect();
        Ok(Tensor::from_vec(values, size, device)?.to_dtype(dtype)?)
    };
    let rows = ramp(height)?.reshape((1, 1, height, 1))?.broadcast_as((1, 1, height, width))?;
    let columns = ramp(width)?.reshape((1, 1, 1, width))?.broadcast_as((1, 1, height, width))?;
    Ok(Tensor::cat(&[rows, columns], 1)?)
}
