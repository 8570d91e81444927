//! SiLU and modulated SiLU in one pass over memory, forward and backward.
//!
//! The upsampler's activations are as many numbers as its convolutions read; candle's own operations take a pass with
//! a fresh allocation for every arithmetic step, most of them in the backward pass, and a scalar exponential.

use candle_core::{CpuStorage, CustomOp1, CustomOp2, CustomOp3, DType, Layout, Shape, Tensor};
use rayon::prelude::*;

use crate::{Error, Result};

/// x · sigmoid(x), any shape.
pub fn silu(x: &Tensor) -> Result<Tensor> {
    if !is_fused(&[x])? {
        // Not candle's own: its gradient, σ (1 − y) + y, cancels to nothing for large x. Below −80 the slope is 1e-33.
        let decay = x.neg()?.minimum(80.0)?.exp()?;
        return Ok((x * (decay + 1.0)?.recip()?)?);
    }
    Ok(x.contiguous()?.apply_op1(Silu)?)
}

/// silu(x · (1 + gain) + shift) of `x` `[B, C, h, w]`, where `modulation` is gain and shift one after the other along
/// the channels: `[B, 2C, h, w]`, or `[B, 2C, 1, 1]` for the same at all pixels.
pub fn modulated_silu(x: &Tensor, modulation: &Tensor) -> Result<Tensor> {
    let (batch, channels, height, width) = x.dims4()?;
    if modulation.dims() == [batch, 2 * channels, height, width] && is_fused(&[x, modulation])? {
        return Ok(x.contiguous()?.apply_op2(&modulation.contiguous()?, ModulatedSilu)?);
    }
    if modulation.dim(1)? != 2 * channels {
        return Err(Error::shape("modulation", [batch, 2 * channels, height, width], modulation.dims()));
    }
    let gain = (modulation.narrow(1, 0, channels)? + 1.0)?;
    let shift = modulation.narrow(1, channels, channels)?;
    silu(&x.broadcast_mul(&gain)?.broadcast_add(&shift)?)
}

/// Whether the passes of this module can do it; else candle does.
fn is_fused(tensors: &[&Tensor]) -> Result<bool> {
    let fits = tensors.iter().all(|tensor| tensor.device().is_cpu() && tensor.dtype() == DType::F32);
    Ok(fits && !crate::Path::is_composed()?)
}

/// sigmoid(x) to about 2 units in the last place, without branches, so that loops over it become vector code.
#[inline(always)]
fn sigmoid(x: f32) -> f32 {
    // Beyond this sigmoid(-x) is below f32's smallest normal number, and 2^k would leave the exponent's range.
    let x = x.clamp(-87.0, 87.0);
    // exp(-x) = 2^k · exp(r) with |r| ≤ ln 2 / 2; adding 1.5 · 2^23 rounds to the integer k, kept in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let shifted = -x * std::f32::consts::LOG2_E + ROUND;
    let k = shifted - ROUND;
    let r = (-x - k * 0.693_359_4) + k * 2.121_944_4e-4;
    let power = f32::from_bits(shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23);
    // Cephes' expf.
    let p = 1.987_569_1e-4;
    let p = p * r + 1.398_199_9e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 0.166_666_65;
    let p = p * r + 0.5;
    1.0 / (1.0 + power * (p * r * r + r + 1.0))
}

/// silu′(x).
#[inline(always)]
fn slope(x: f32) -> f32 {
    let s = sigmoid(x);
    s + x * s * (1.0 - s)
}

/// Loops over equally long slices, compiled once for the baseline processor and once for those with AVX-512 and AVX2.
macro_rules! loops {
    ($(fn $name:ident($output:ident: &mut [f32], $($input:ident),+) $body:expr;)+) => {
        $(
            fn $name($output: &mut [f32], $($input: &[f32]),+) {
                #[inline(always)]
                fn body($output: &mut [f32], $($input: &[f32]),+) {
                    let length = $output.len();
                    $(let $input = &$input[..length];)+
                    for (index, $output) in $output.iter_mut().enumerate() {
                        $(let $input = $input[index];)+
                        *$output = $body;
                    }
                }
                #[cfg(target_arch = "x86_64")]
                {
                    #[target_feature(enable = "avx512f")]
                    fn wide($output: &mut [f32], $($input: &[f32]),+) {
                        body($output, $($input),+)
                    }
                    #[target_feature(enable = "avx2")]
                    fn narrow($output: &mut [f32], $($input: &[f32]),+) {
                        body($output, $($input),+)
                    }
                    if is_x86_feature_detected!("avx512f") {
                        // SAFETY: the processor has AVX-512, as just asked.
                        return unsafe { wide($output, $($input),+) };
                    }
                    if is_x86_feature_detected!("avx2") {
                        // SAFETY: the processor has AVX2, as just asked.
                        return unsafe { narrow($output, $($input),+) };
                    }
                }
                body($output, $($input),+)
            }
        )+
    };
}

loops! {
    fn silu_loop(output: &mut [f32], x) x * sigmoid(x);
    fn silu_slope_loop(output: &mut [f32], x, gradient) gradient * slope(x);
    fn modulated_loop(output: &mut [f32], x, gain, shift) {
        let h = x * (1.0 + gain) + shift;
        h * sigmoid(h)
    };
    fn modulated_x_loop(output: &mut [f32], x, gain, shift, gradient) {
        gradient * slope(x * (1.0 + gain) + shift) * (1.0 + gain)
    };
    fn modulated_gain_loop(output: &mut [f32], x, gain, shift, gradient) {
        gradient * slope(x * (1.0 + gain) + shift) * x
    };
    fn modulated_shift_loop(output: &mut [f32], x, gain, shift, gradient) {
        gradient * slope(x * (1.0 + gain) + shift)
    };
}

/// Numbers of a task: enough to be worth a thread, few enough to stay in its cache.
const CHUNK: usize = 1 << 14;

struct Silu;

impl CustomOp1 for Silu {
    fn name(&self) -> &'static str {
        "silu"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let x = contiguous(storage, layout)?;
        let mut output = vec![0f32; x.len()];
        output.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK)).for_each(|(output, x)| silu_loop(output, x));
        Ok((CpuStorage::F32(output), layout.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, gradient: &Tensor) -> candle_core::Result<Option<Tensor>> {
        Ok(Some(x.apply_op2_no_bwd(&gradient.contiguous()?, &SiluSlope)?))
    }
}

struct SiluSlope;

impl CustomOp2 for SiluSlope {
    fn name(&self) -> &'static str {
        "silu-gradient"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        gradient: &CpuStorage,
        gradient_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (x, gradient) = (contiguous(x, x_layout)?, contiguous(gradient, gradient_layout)?);
        let mut output = vec![0f32; x.len()];
        let inputs = x.par_chunks(CHUNK).zip(gradient.par_chunks(CHUNK));
        output.par_chunks_mut(CHUNK).zip(inputs).for_each(|(output, (x, gradient))| {
            silu_slope_loop(output, x, gradient);
        });
        Ok((CpuStorage::F32(output), x_layout.shape().clone()))
    }
}

struct ModulatedSilu;

impl CustomOp2 for ModulatedSilu {
    fn name(&self) -> &'static str {
        "modulated-silu"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        modulation: &CpuStorage,
        modulation_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let planes = Planes::new(x, x_layout, modulation, modulation_layout)?;
        let mut output = vec![0f32; planes.x.len()];
        output.par_chunks_mut(planes.size).enumerate().for_each(|(plane, output)| {
            let (x, gain, shift) = planes.get(plane / planes.channels, plane % planes.channels);
            modulated_loop(output, x, gain, shift);
        });
        Ok((CpuStorage::F32(output), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        modulation: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let gradient = gradient.contiguous()?;
        let of = |of| x.apply_op3_no_bwd(modulation, &gradient, &ModulatedGradient { of });
        Ok((Some(of(Argument::X)?), Some(of(Argument::Modulation)?)))
    }
}

#[derive(Clone, Copy)]
enum Argument {
    X,
    Modulation,
}

struct ModulatedGradient {
    of: Argument,
}

impl CustomOp3 for ModulatedGradient {
    fn name(&self) -> &'static str {
        "modulated-silu-gradient"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        modulation: &CpuStorage,
        modulation_layout: &Layout,
        gradient: &CpuStorage,
        gradient_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let planes = Planes::new(x, x_layout, modulation, modulation_layout)?;
        let gradient = contiguous(gradient, gradient_layout)?;
        let (rows, shape) = match self.of {
            Argument::X => (planes.channels, x_layout.shape()),
            Argument::Modulation => (2 * planes.channels, modulation_layout.shape()),
        };
        let mut output = vec![0f32; shape.elem_count()];
        output.par_chunks_mut(planes.size).enumerate().for_each(|(plane, output)| {
            let (picture, row) = (plane / rows, plane % rows);
            let channel = row % planes.channels;
            let (x, gain, shift) = planes.get(picture, channel);
            let gradient = &gradient[(picture * planes.channels + channel) * planes.size..][..planes.size];
            match self.of {
                Argument::X => modulated_x_loop(output, x, gain, shift, gradient),
                Argument::Modulation if row < planes.channels => {
                    modulated_gain_loop(output, x, gain, shift, gradient);
                }
                Argument::Modulation => modulated_shift_loop(output, x, gain, shift, gradient),
            }
        });
        Ok((CpuStorage::F32(output), shape.clone()))
    }
}

/// A picture and its modulation, plane by plane.
struct Planes<'a> {
    x: &'a [f32],
    modulation: &'a [f32],
    channels: usize,
    size: usize,
}

impl<'a> Planes<'a> {
    fn new(
        x: &'a CpuStorage,
        x_layout: &Layout,
        modulation: &'a CpuStorage,
        modulation_layout: &Layout,
    ) -> candle_core::Result<Self> {
        let (_, channels, height, width) = x_layout.shape().dims4()?;
        let (x, modulation) = (contiguous(x, x_layout)?, contiguous(modulation, modulation_layout)?);
        if modulation.len() != 2 * x.len() {
            candle_core::bail!("modulation {:?} of {:?}", modulation_layout.shape(), x_layout.shape());
        }
        Ok(Self { x, modulation, channels, size: (height * width).max(1) })
    }

    /// x, gain and shift of one channel of one picture.
    fn get(&self, picture: usize, channel: usize) -> (&[f32], &[f32], &[f32]) {
        let plane = |values: &'a [f32], index: usize| &values[index * self.size..][..self.size];
        let gain = picture * 2 * self.channels + channel;
        let x = plane(self.x, picture * self.channels + channel);
        (x, plane(self.modulation, gain), plane(self.modulation, gain + self.channels))
    }
}

fn contiguous<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => candle_core::bail!("activation of a tensor that is not contiguous"),
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;
    use crate::random::Stream;

    #[test]
    fn sigmoid_is_exact_to_rounding_and_holds_far_out() {
        for step in -20_000..=20_000 {
            let x = step as f32 * 0.005;
            let exact = 1.0 / (1.0 + (-f64::from(x)).exp());
            let error = (f64::from(sigmoid(x)) - exact).abs() / exact.max(1e-30);
            assert!(error < 4e-7 || x < -87.0, "{x}: {error:e}");
        }
        for x in [1e30f32, f32::INFINITY] {
            assert_eq!(sigmoid(x), 1.0);
            assert!(sigmoid(-x) < 2e-38);
        }
        assert!(sigmoid(f32::NAN).is_nan());
    }

    /// Value and gradients in f32, fused, against f64, composed.
    fn compare(shape: [usize; 4], modulated_pixels: [usize; 2]) {
        let draw = |seed, shape: &[usize]| Stream::new(seed, &[]).normal_tensor(shape, &Device::Cpu).unwrap();
        let [batch, channels, ..] = shape;
        let x = (draw(1, &shape) * 3.0).unwrap();
        let modulation = draw(2, &[batch, 2 * channels, modulated_pixels[0], modulated_pixels[1]]);
        let weight = draw(3, &shape);
        let run = |dtype: DType| -> Vec<Tensor> {
            let double = |tensor: &Tensor| tensor.to_dtype(dtype).unwrap();
            let (x, modulation) =
                (Var::from_tensor(&double(&x)).unwrap(), Var::from_tensor(&double(&modulation)).unwrap());
            let plain = silu(&x).unwrap();
            let output = (modulated_silu(&x, &modulation).unwrap() + &plain).unwrap();
            let gradients = (&output * double(&weight)).unwrap().sum_all().unwrap().backward().unwrap();
            let gradients = [gradients.get(&x).unwrap().clone(), gradients.get(&modulation).unwrap().clone()];
            [output].into_iter().chain(gradients).collect()
        };
        for (fused, exact) in run(DType::F32).into_iter().zip(run(DType::F64)) {
            let norm = |tensor: &Tensor| tensor.sqr().unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap().sqrt();
            let error = norm(&(fused.to_dtype(DType::F64).unwrap() - &exact).unwrap()) / norm(&exact);
            assert!(error < 1e-6, "{shape:?} {modulated_pixels:?}: {error:e}");
        }
    }

    #[test]
    fn values_and_gradients_match_f64() {
        compare([2, 3, 5, 7], [5, 7]);
        compare([2, 3, 5, 7], [1, 1]);
        compare([1, 1, 1, 1], [1, 1]);
        compare([1, 2, 140, 130], [140, 130]);
    }

    #[test]
    fn a_modulation_of_another_width_is_an_error() {
        let zeros = |shape: (usize, usize, usize, usize)| Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap();
        assert!(modulated_silu(&zeros((1, 3, 4, 4)), &zeros((1, 5, 4, 4))).is_err());
    }
}
