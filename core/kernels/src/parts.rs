//! An evaluation of the local generators read in parts, whose gradients are put together once.
//!
//! candle adds the gradient of every use of a tensor to a sum as large as the tensor, and a part's gradient is as large as the
//! whole: for the quarter of a gigabyte that a picture's evaluation is, a dozen passes over memory. Here all parts hang on one
//! number, the knot, that hangs on the evaluation's inputs. Each part leaves what flows back to it with the knot, whose own
//! turn comes when all parts have had theirs.

use std::{
    mem,
    ops::Range,
    sync::{Arc, Mutex, PoisonError},
};

use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Shape, Storage, Tensor};
use rayon::prelude::*;

use crate::{
    Error, Result,
    rays::{self, RaySum},
};

/// Rows of an evaluation `[B, k, C, N]`, see [`crate::autograd::evaluate_in_parts`]. Clones share their gradients' place.
#[derive(Clone, Debug)]
pub struct Parts {
    /// Without a graph of its own where there is a knot.
    values: Tensor,
    knot: Option<Knot>,
    rows: Range<usize>,
}

#[derive(Clone, Debug)]
struct Knot {
    tensor: Tensor,
    left: Arc<Left>,
}

/// What flowed back to the parts in the backward pass under way.
#[derive(Debug, Default)]
pub(crate) struct Left(Mutex<Vec<Share>>);

#[derive(Debug)]
enum Share {
    /// To rows as they are, `[B, k, rows, N]`.
    Rows { rows: Range<usize>, gradient: Tensor },
    /// To rows summed along rays: `gradient` `[B, k, rows, R]` times `weights` `[B, k, R · samples]`.
    RaySum { rows: Range<usize>, gradient: Tensor, weights: Tensor, samples: usize },
}

impl Parts {
    /// All rows of `values`, which may have a graph of their own.
    pub fn new(values: Tensor) -> Result<Self> {
        let rows = 0..values.dims4()?.2;
        Ok(Self { values, knot: None, rows })
    }

    /// All rows of `values` without a graph, hanging on `knot`.
    pub(crate) fn tied(values: Tensor, knot: Tensor, left: Arc<Left>) -> Result<Self> {
        Ok(Self { knot: Some(Knot { tensor: knot, left }), ..Self::new(values)? })
    }

    /// Some of these rows.
    ///
    /// # Errors
    /// If there are fewer.
    pub fn rows(&self, rows: Range<usize>) -> Result<Self> {
        if rows.start > rows.end || rows.end > self.rows.len() {
            return Err(Error::shape("rows", format!("within {}", self.rows.len()), &[rows.start, rows.end]));
        }
        Ok(Self { rows: self.rows.start + rows.start..self.rows.start + rows.end, ..self.clone() })
    }

    /// These rows as a tensor `[B, k, rows, N]`.
    ///
    /// # Errors
    /// If candle errs.
    pub fn tensor(&self) -> Result<Tensor> {
        let values = self.narrowed()?;
        let Some(Knot { tensor, left }) = &self.knot else { return Ok(values) };
        Ok(tensor.apply_op1(Rows { values, rows: self.rows.clone(), left: left.clone() })?)
    }

    /// [`rays::weighted_ray_sum`] of these rows.
    ///
    /// # Errors
    /// As there.
    pub fn ray_sum(&self, weights: &Tensor, samples: usize) -> Result<Tensor> {
        let values = self.narrowed()?;
        let Some(Knot { tensor, left }) = &self.knot else { return rays::weighted_ray_sum(&values, weights, samples) };
        rays::check(&values, weights, samples)?;
        let sum = TiedRaySum { values, rows: self.rows.clone(), left: left.clone(), samples };
        Ok(tensor.apply_op2(&weights.contiguous()?, sum)?)
    }

    fn narrowed(&self) -> Result<Tensor> {
        Ok(self.values.narrow(2, self.rows.start, self.rows.len())?)
    }
}

impl Left {
    fn push(&self, share: Share) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).push(share);
    }

    /// The gradient of the whole evaluation `[B, k, C, N]`, here as `[pairs, channels, points]`; nothing is left after.
    pub(crate) fn take(&self, (pairs, channels, points): (usize, usize, usize)) -> candle_core::Result<Vec<f32>> {
        let shares = mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner));
        let shares: Vec<Share> = shares.into_iter().map(Share::contiguous).collect::<candle_core::Result<_>>()?;
        let stored: Vec<_> = shares
            .iter()
            .map(Share::tensors)
            .map(|(gradient, weights)| (gradient.storage_and_layout(), weights.map(Tensor::storage_and_layout)))
            .collect();
        let shares: Vec<_> = shares
            .iter()
            .zip(&stored)
            .map(|(share, ((gradient, layout), weights))| {
                let weights = weights.as_ref().map(|(weights, layout)| plain(weights, layout)).transpose()?;
                Ok((share.rows(), share.samples(), plain(gradient, layout)?, weights))
            })
            .collect::<candle_core::Result<_>>()?;
        let mut whole = vec![0f32; pairs * channels * points];
        whole.par_chunks_mut(points.max(1)).enumerate().for_each(|(row, whole)| {
            let (pair, channel) = (row / channels, row % channels);
            for (rows, samples, gradient, weights) in shares.iter().filter(|(rows, ..)| rows.contains(&channel)) {
                let place = pair * rows.len() + channel - rows.start;
                match weights {
                    None => {
                        let gradient = &gradient[place * points..][..points];
                        whole.iter_mut().zip(gradient).for_each(|(whole, gradient)| *whole += gradient);
                    }
                    Some(weights) => {
                        let weights = weights[pair * points..][..points].chunks_exact(*samples);
                        let gradient = &gradient[place * (points / samples)..];
                        for ((whole, weights), gradient) in whole.chunks_exact_mut(*samples).zip(weights).zip(gradient)
                        {
                            whole.iter_mut().zip(weights).for_each(|(whole, weight)| *whole += gradient * weight);
                        }
                    }
                }
            }
        });
        Ok(whole)
    }
}

impl Share {
    fn contiguous(self) -> candle_core::Result<Self> {
        Ok(match self {
            Self::Rows { rows, gradient } => Self::Rows { rows, gradient: gradient.contiguous()? },
            Self::RaySum { rows, gradient, weights, samples } => {
                Self::RaySum { rows, gradient: gradient.contiguous()?, weights: weights.contiguous()?, samples }
            }
        })
    }

    fn rows(&self) -> &Range<usize> {
        match self {
            Self::Rows { rows, .. } | Self::RaySum { rows, .. } => rows,
        }
    }

    fn samples(&self) -> usize {
        match self {
            Self::Rows { .. } => 1,
            Self::RaySum { samples, .. } => *samples,
        }
    }

    /// The gradient, and the weights it counts with.
    fn tensors(&self) -> (&Tensor, Option<&Tensor>) {
        match self {
            Self::Rows { gradient, .. } => (gradient, None),
            Self::RaySum { gradient, weights, .. } => (gradient, Some(weights)),
        }
    }
}

struct Rows {
    values: Tensor,
    rows: Range<usize>,
    left: Arc<Left>,
}

impl CustomOp1 for Rows {
    fn name(&self) -> &'static str {
        "rows"
    }

    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let values = self.values.contiguous()?;
        let (storage, layout) = values.storage_and_layout();
        Ok((CpuStorage::F32(plain(&storage, layout)?.to_vec()), self.values.shape().clone()))
    }

    fn bwd(&self, knot: &Tensor, _: &Tensor, gradient: &Tensor) -> candle_core::Result<Option<Tensor>> {
        self.left.push(Share::Rows { rows: self.rows.clone(), gradient: gradient.clone() });
        Ok(Some(knot.zeros_like()?))
    }
}

struct TiedRaySum {
    values: Tensor,
    rows: Range<usize>,
    left: Arc<Left>,
    samples: usize,
}

impl CustomOp2 for TiedRaySum {
    fn name(&self) -> &'static str {
        "tied-ray-sum"
    }

    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        weights: &CpuStorage,
        weights_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (storage, layout) = self.values.storage_and_layout();
        let Storage::Cpu(values) = &*storage else { candle_core::bail!("evaluations in parts are on the CPU") };
        RaySum { samples: self.samples }.cpu_fwd(values, layout, weights, weights_layout)
    }

    fn bwd(
        &self,
        knot: &Tensor,
        weights: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let of_weights = || rays::gradient_of_share(&self.values, weights, &gradient.contiguous()?, self.samples);
        let of_weights = weights.track_op().then(of_weights).transpose()?;
        let (rows, samples) = (self.rows.clone(), self.samples);
        self.left.push(Share::RaySum { rows, gradient: gradient.clone(), weights: weights.detach(), samples });
        Ok((Some(knot.zeros_like()?), of_weights))
    }
}

fn plain<'a>(storage: &'a Storage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (Storage::Cpu(storage), Some((start, end))) => Ok(&storage.as_slice::<f32>()?[start..end]),
        _ => candle_core::bail!("gradients of an evaluation in parts are contiguous and on the CPU"),
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;
    use crate::{HeadShape, Outputs, SdfHead, autograd, random::Stream};

    /// Gradients of points, weights and FiLM of a loss on parts, some used twice and some not at all, of an evaluation as
    /// one tensor and in parts.
    #[test]
    fn values_and_gradients_are_those_of_the_whole_tensor() {
        let shape = HeadShape { width: 8, sdf_head: SdfHead::Shape, mask_view: false, colour_view: false };
        let outputs = Outputs { gradient: true, colour: true, activations: true };
        let draw = |seed, shape: &[usize]| Stream::new(seed, &[]).normal_tensor(shape, &Device::Cpu).unwrap();
        let (rays, samples) = (5, 3);
        let inputs = [
            draw(1, &[2, rays * samples, 3]),
            draw(2, &[4, shape.parameter_count()]),
            draw(3, &[2, 4, 5, 2, 8]),
            draw(4, &[2, 4, rays * samples]),
        ];
        let rows = shape.rows(outputs);
        let (colour, activations) = (rows.colour.unwrap(), rows.activations.unwrap());
        let run = |in_parts: bool| -> Vec<Vec<f32>> {
            let variables: Vec<Var> = inputs.iter().map(|input| Var::from_tensor(input).unwrap()).collect();
            let [points, weights, film, share] = &variables[..] else { unreachable!() };
            let parts = if in_parts {
                autograd::evaluate_in_parts(points, weights, film, shape, outputs).unwrap()
            } else {
                Parts::new(autograd::evaluate(points, weights, film, shape, outputs).unwrap()).unwrap()
            };
            assert_eq!(parts.knot.is_some(), in_parts);
            let part = |rows: Range<usize>| parts.rows(rows).unwrap();
            let mask = part(rows.mask..rows.mask + 1).tensor().unwrap();
            let sums = part(activations.clone()).ray_sum(share, samples).unwrap();
            let again = part(activations.clone()).rows(1..3).unwrap().tensor().unwrap();
            let terms = [mask.sqr(), part(colour.clone()).tensor().unwrap().sqr(), sums.sqr(), again.sqr(), mask.exp()];
            let sum = |term: candle_core::Result<Tensor>| term.unwrap().sum_all().unwrap();
            let loss = terms.into_iter().map(sum).reduce(|sum, term| (sum + term).unwrap()).unwrap();
            let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let backward = || {
                let gradients = loss.backward().unwrap();
                let all = variables.iter().map(|variable| values(gradients.get(variable).unwrap()));
                all.collect::<Vec<_>>()
            };
            let first = backward();
            assert_eq!(first, backward(), "a second pass finds nothing of the first");
            [values(&mask), values(&sums)].into_iter().chain(first).collect()
        };
        for (whole, parts) in run(false).iter().zip(run(true)) {
            let largest = whole.iter().fold(0f32, |largest, value| largest.max(value.abs()));
            // The same terms added in another order.
            let off = whole.iter().zip(&parts).fold(0f32, |off, (a, b)| off.max((a - b).abs()));
            assert!(off <= 2e-6 * largest, "{off:e} of {largest}");
        }
    }

    #[test]
    fn rows_that_are_not_there_are_errors() {
        let parts = Parts::new(Tensor::zeros((1, 2, 5, 3), candle_core::DType::F32, &Device::Cpu).unwrap()).unwrap();
        assert!(parts.rows(3..6).is_err() && parts.rows(1..4).unwrap().rows(2..4).is_err());
        assert_eq!(parts.rows(1..4).unwrap().rows(1..3).unwrap().tensor().unwrap().dims(), [1, 2, 2, 3]);
    }
}
