//! Weighted sums along rays in one pass over memory, forward and backward.
//!
//! A picture's last hidden layers are a quarter of a gigabyte; candle's own operations would write them four more times
//! (masked, weighted, and the gradients of both) to add them up along the rays.

use candle_core::{CpuStorage, CustomOp2, CustomOp3, D, DType, Layout, Shape, Tensor};
use rayon::prelude::*;

use crate::{Error, Result};

/// Rays of a task of the backward pass: their samples of one channel stay in the nearest cache.
const RAYS_A_TASK: usize = 64;

/// Σ over the S samples of each ray of `share` `[B, k, R · S]` times `values` `[B, k, C, R · S]`: `[B, k, C, R]`.
/// Differentiable in both. Rows of `values` may be any part of a larger tensor's.
///
/// # Errors
/// If the shapes do not fit each other, or candle errs.
pub fn weighted_ray_sum(values: &Tensor, share: &Tensor, samples: usize) -> Result<Tensor> {
    check(values, share, samples)?;
    let (batch, regions, channels, points) = values.dims4()?;
    let fits = |tensor: &Tensor| tensor.device().is_cpu() && tensor.dtype() == DType::F32;
    if fits(values) && fits(share) && !crate::Path::is_composed()? {
        let values = if values.stride().last() == Some(&1) { values.clone() } else { values.contiguous()? };
        return Ok(values.apply_op2(&share.contiguous()?, RaySum { samples })?);
    }
    let weighted = values.broadcast_mul(&share.unsqueeze(2)?)?;
    Ok(weighted.reshape((batch, regions, channels, points / samples, samples))?.sum(D::Minus1)?)
}

/// Refuses shapes that do not fit each other.
pub(crate) fn check(values: &Tensor, share: &Tensor, samples: usize) -> Result<()> {
    let (batch, regions, _, points) = values.dims4()?;
    if share.dims() != [batch, regions, points] || samples == 0 || points % samples != 0 {
        return Err(Error::shape("share", [batch, regions, points], share.dims()));
    }
    Ok(())
}

/// The gradient of `share` where `gradient` `[B, k, C, R]`, contiguous, is that of the sums.
pub(crate) fn gradient_of_share(
    values: &Tensor,
    share: &Tensor,
    gradient: &Tensor,
    samples: usize,
) -> candle_core::Result<Tensor> {
    values.apply_op3_no_bwd(share, gradient, &RaySumGradient { samples, of: Argument::Share })
}

pub(crate) struct RaySum {
    pub samples: usize,
}

impl CustomOp2 for RaySum {
    fn name(&self) -> &'static str {
        "ray-sum"
    }

    fn cpu_fwd(
        &self,
        values: &CpuStorage,
        values_layout: &Layout,
        share: &CpuStorage,
        share_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let values = Rows::new(values, values_layout)?;
        let share = contiguous(share, share_layout)?;
        let rays = values.points / self.samples;
        let mut output = vec![0f32; values.batch * values.regions * values.channels * rays];
        output.par_chunks_mut(rays.max(1)).enumerate().for_each(|(row, output)| {
            let (region, channel) = (row / values.channels, row % values.channels);
            let share = &share[region * values.points..][..values.points];
            let samples = values.row(region, channel).chunks_exact(self.samples).zip(share.chunks_exact(self.samples));
            output.iter_mut().zip(samples).for_each(|(output, (values, share))| *output = dot(values, share));
        });
        Ok((CpuStorage::F32(output), (values.batch, values.regions, values.channels, rays).into()))
    }

    fn bwd(
        &self,
        values: &Tensor,
        share: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let gradient = gradient.contiguous()?;
        let of_values = || {
            let operation = RaySumGradient { samples: self.samples, of: Argument::Values };
            values.apply_op3_no_bwd(share, &gradient, &operation)
        };
        let of_share = || gradient_of_share(values, share, &gradient, self.samples);
        Ok((values.track_op().then(of_values).transpose()?, share.track_op().then(of_share).transpose()?))
    }
}

#[derive(Clone, Copy)]
enum Argument {
    Values,
    Share,
}

struct RaySumGradient {
    samples: usize,
    of: Argument,
}

impl CustomOp3 for RaySumGradient {
    fn name(&self) -> &'static str {
        "ray-sum-gradient"
    }

    fn cpu_fwd(
        &self,
        values: &CpuStorage,
        values_layout: &Layout,
        share: &CpuStorage,
        share_layout: &Layout,
        gradient: &CpuStorage,
        gradient_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let values = Rows::new(values, values_layout)?;
        let (share, gradient) = (contiguous(share, share_layout)?, contiguous(gradient, gradient_layout)?);
        let (points, channels, samples) = (values.points, values.channels, self.samples);
        let rays = points / samples;
        match self.of {
            Argument::Values => {
                let mut output = vec![0f32; values.batch * values.regions * channels * points];
                output.par_chunks_mut(points.max(1)).enumerate().for_each(|(row, output)| {
                    let share = &share[row / channels * points..][..points];
                    let each = output.chunks_exact_mut(samples).zip(share.chunks_exact(samples));
                    for ((output, share), gradient) in each.zip(&gradient[row * rays..]) {
                        output.iter_mut().zip(share).for_each(|(output, share)| *output = gradient * share);
                    }
                });
                Ok((CpuStorage::F32(output), values_layout.shape().clone()))
            }
            Argument::Share => {
                let mut output = vec![0f32; share.len()];
                let block = RAYS_A_TASK * samples;
                output.par_chunks_mut(points.max(1)).enumerate().for_each(|(region, output)| {
                    output.par_chunks_mut(block).enumerate().for_each(|(task, output)| {
                        for channel in 0..channels {
                            let values = &values.row(region, channel)[task * block..][..output.len()];
                            let gradient = &gradient[(region * channels + channel) * rays + task * RAYS_A_TASK..];
                            let each = output.chunks_exact_mut(samples).zip(values.chunks_exact(samples));
                            for ((output, values), gradient) in each.zip(gradient) {
                                output.iter_mut().zip(values).for_each(|(output, value)| *output += gradient * value);
                            }
                        }
                    });
                });
                Ok((CpuStorage::F32(output), share_layout.shape().clone()))
            }
        }
    }
}

/// Σ left · right in eight sums side by side: one vector instruction each, and an order that never changes.
#[inline(always)]
fn dot(left: &[f32], right: &[f32]) -> f32 {
    let mut lanes = [0f32; 8];
    let (left, right) = (left.chunks_exact(8), right.chunks_exact(8));
    let rest: f32 = left.remainder().iter().zip(right.remainder()).map(|(left, right)| left * right).sum();
    for (left, right) in left.zip(right) {
        lanes.iter_mut().zip(left).zip(right).for_each(|((lane, left), right)| *lane += left * right);
    }
    lanes.iter().sum::<f32>() + rest
}

/// A tensor `[B, k, C, N]` whose rows of N values lie side by side, wherever each row begins.
struct Rows<'a> {
    storage: &'a [f32],
    batch: usize,
    regions: usize,
    channels: usize,
    points: usize,
    start: usize,
    strides: [usize; 3],
}

impl<'a> Rows<'a> {
    fn new(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<Self> {
        let (batch, regions, channels, points) = layout.shape().dims4()?;
        let &[of_batch, of_region, of_channel, 1] = layout.stride() else {
            candle_core::bail!("ray sums need rows whose values lie side by side");
        };
        let strides = [of_batch, of_region, of_channel];
        let start = layout.start_offset();
        Ok(Self { storage: storage.as_slice::<f32>()?, batch, regions, channels, points, start, strides })
    }

    /// A channel's values; `region` counts through all portraits.
    fn row(&self, region: usize, channel: usize) -> &'a [f32] {
        let [of_batch, of_region, of_channel] = self.strides;
        let (portrait, region) = (region / self.regions, region % self.regions);
        let first = self.start + portrait * of_batch + region * of_region + channel * of_channel;
        &self.storage[first..][..self.points]
    }
}

fn contiguous<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&storage.as_slice::<f32>()?[start..end]),
        None => candle_core::bail!("ray sum of a tensor that is not contiguous"),
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;
    use crate::random::Stream;

    /// Value and gradients in f32, fused, against f64, composed; values are the last rows of a larger tensor.
    fn compare([batch, regions, channels, rays, samples]: [usize; 5]) {
        let draw = |seed, shape: &[usize]| Stream::new(seed, &[]).normal_tensor(shape, &Device::Cpu).unwrap();
        let raw = draw(1, &[batch, regions, channels + 3, rays * samples]);
        let share = draw(2, &[batch, regions, rays * samples]);
        let weight = draw(3, &[batch, regions, channels, rays]);
        let run = |dtype: DType| -> Vec<Tensor> {
            let double = |tensor: &Tensor| tensor.to_dtype(dtype).unwrap();
            let (raw, share) = (Var::from_tensor(&double(&raw)).unwrap(), Var::from_tensor(&double(&share)).unwrap());
            let values = raw.narrow(2, 3, channels).unwrap();
            let output = weighted_ray_sum(&values, &share, samples).unwrap();
            let gradients = (&output * double(&weight)).unwrap().sum_all().unwrap().backward().unwrap();
            let gradients = [gradients.get(&raw).unwrap().clone(), gradients.get(&share).unwrap().clone()];
            [output].into_iter().chain(gradients).collect()
        };
        for (fused, exact) in run(DType::F32).into_iter().zip(run(DType::F64)) {
            assert_eq!(fused.dims(), exact.dims());
            let norm = |tensor: &Tensor| tensor.sqr().unwrap().sum_all().unwrap().to_scalar::<f64>().unwrap().sqrt();
            let error = norm(&(fused.to_dtype(DType::F64).unwrap() - &exact).unwrap()) / norm(&exact);
            // Sums of up to some hundred rounded products.
            assert!(error < 2e-6, "{batch} {regions} {channels} {rays} {samples}: {error:e}");
        }
    }

    #[test]
    fn values_and_gradients_match_f64() {
        compare([1, 1, 1, 1, 1]);
        compare([2, 3, 4, 5, 7]);
        compare([1, 8, 6, 150, 24]);
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let zeros = |shape: &[usize]| Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap();
        assert!(weighted_ray_sum(&zeros(&[1, 2, 3, 8]), &zeros(&[1, 2, 9]), 4).is_err());
        assert!(weighted_ray_sum(&zeros(&[1, 2, 3, 8]), &zeros(&[1, 2, 8]), 3).is_err());
        assert!(weighted_ray_sum(&zeros(&[1, 2, 3, 8]), &zeros(&[1, 2, 8]), 0).is_err());
    }
}
