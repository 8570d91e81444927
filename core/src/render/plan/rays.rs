//! A chunk of rays as plain numbers.

use candle_core::{DType, Tensor};

use crate::{
    error::Result,
    render::{RayBundle, Sampling, plan::local::length},
};

/// Some rays of one camera with their samples.
#[derive(Clone, Debug)]
pub struct Rays {
    /// World.
    pub origin: [f32; 3],
    /// World, un-normalised: one depth unit along the view axis.
    pub directions: Vec<[f32; 3]>,
    /// Of unit length.
    pub views: Vec<[f32; 3]>,
    /// S.
    pub samples: usize,
    /// Depths along the view axis, `[n, S]`.
    pub depths: Vec<f32>,
    /// Lengths the samples stand for, world units, `[n, S]`.
    pub lengths: Vec<f32>,
    /// Whether the last sample takes all the light that is left.
    pub closed: bool,
}

impl Rays {
    /// Rays `start .. start + count` of picture `image`, with samples at `depths` `[B, R, S]` (or 1 in place of B or R).
    pub fn new(
        bundle: &RayBundle,
        depths: &Tensor,
        sampling: &Sampling,
        image: usize,
        (start, count): (usize, usize),
    ) -> Result<Self> {
        let samples = depths.dim(2)?;
        let depths = if depths.dim(0)? == 1 { depths.clone() } else { depths.narrow(0, image, 1)? };
        let depths = if depths.dim(1)? == 1 { depths } else { depths.narrow(1, start, count)? };
        let lengths = sampling.intervals(&depths)?;
        let directions = triples(&bundle.directions.narrow(0, image, 1)?.narrow(1, start, count)?)?;
        let mut rays = Self {
            origin: triples(&bundle.origins.narrow(0, image, 1)?)?.into_iter().next().unwrap_or_default(),
            views: triples(&bundle.view_directions.narrow(0, image, 1)?.narrow(1, start, count)?)?,
            samples,
            depths: spread(&depths, count)?,
            lengths: spread(&lengths, count)?,
            closed: sampling.last_interval.is_none(),
            directions,
        };
        for (lengths, direction) in rays.lengths.chunks_exact_mut(samples.max(1)).zip(&rays.directions) {
            let unit = length(*direction);
            lengths.iter_mut().for_each(|length| *length *= unit);
        }
        Ok(rays)
    }

    /// n.
    pub fn count(&self) -> usize {
        self.directions.len()
    }

    /// The largest length that a sample stands for, world units.
    pub fn longest(&self) -> f32 {
        self.lengths.iter().fold(0.0, |longest, length| longest.max(*length))
    }

    /// Some of them.
    pub fn part(&self, rays: std::ops::Range<usize>) -> Self {
        let samples = rays.start * self.samples..rays.end * self.samples;
        Self {
            origin: self.origin,
            directions: self.directions[rays.clone()].to_vec(),
            views: self.views[rays].to_vec(),
            samples: self.samples,
            depths: self.depths[samples.clone()].to_vec(),
            lengths: self.lengths[samples].to_vec(),
            closed: self.closed,
        }
    }

    /// The world point of a sample, numbered ray by ray.
    pub fn point(&self, sample: usize) -> [f32; 3] {
        let (direction, depth) = (self.directions[sample / self.samples], self.depths[sample]);
        std::array::from_fn(|axis| direction[axis] * depth + self.origin[axis])
    }

    /// Appends what the generators read of a sample: 3 or 6 values.
    pub fn push_input(&self, sample: usize, columns: usize, inputs: &mut Vec<f32>) {
        inputs.extend(self.point(sample).map(super::local::scaled));
        if columns > 3 {
            inputs.extend(self.views[sample / self.samples]);
        }
    }
}

fn triples(tensor: &Tensor) -> Result<Vec<[f32; 3]>> {
    let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
    Ok(values.chunks_exact(3).map(|values| [values[0], values[1], values[2]]).collect())
}

/// `[1, 1 or n, S]` as n rows of S.
fn spread(tensor: &Tensor, count: usize) -> Result<Vec<f32>> {
    let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
    Ok(if tensor.dim(1)? == 1 && count != 1 { values.repeat(count) } else { values })
}
