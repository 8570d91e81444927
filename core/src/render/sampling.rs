//! Where samples lie along rays: depths along the view axis, where `origin + depth * direction` is the sample.

use candle_core::{D, DType, Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::{
    camera,
    error::{Error, Result},
    rng::Stream,
};

/// How a ray's samples are placed between `near` and `far`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Placement {
    /// The authors': the left ends of equal intervals; when perturbed, all of a ray's samples shift by the same
    /// uniform share of an interval.
    Offset,
    /// The middles of equal intervals; when perturbed, each sample is uniform in its own interval.
    Stratified,
}

/// A ray's samples.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Sampling {
    /// How samples are placed.
    pub placement: Placement,
    /// Depth at which the sampled range begins, world units along the view axis.
    pub near: f64,
    /// Depth at which it ends.
    pub far: f64,
    /// Samples per ray.
    pub samples: usize,
    /// Interval that belongs to the last sample, world units along the view axis; none gives it all the light that
    /// is left, so that the ray is closed.
    pub last_interval: Option<f64>,
}

/// Where the recipe's range begins: the head begins a little behind the near plane.
const RECIPE_NEAR: f64 = 0.895;
/// Where it ends: a little before the far plane, where only the background is.
const RECIPE_FAR: f64 = 1.10;

/// The authors' stand-in for infinity.
const AUTHORS_LAST_INTERVAL: f64 = 1e10;

impl Default for Sampling {
    fn default() -> Self {
        Self::behind_the_surface(24)
    }
}

impl Sampling {
    /// Rays that end on the last sample: for fields whose background is a region of the volume (the paper's).
    pub fn closed(samples: usize) -> Self {
        Self { placement: Placement::Offset, near: camera::NEAR, far: camera::FAR, samples, last_interval: None }
    }

    /// As [`Self::closed`], to the letter of the authors' code: a last interval so long that it nearly always closes
    /// the ray, though not where the density is below 1e-9.
    pub fn authors(samples: usize) -> Self {
        Self { last_interval: Some(AUTHORS_LAST_INTERVAL), ..Self::closed(samples) }
    }

    /// Rays that go on to the far plane: for fields whose background is there (the recipe's).
    pub fn behind_the_surface(samples: usize) -> Self {
        Self {
            placement: Placement::Stratified,
            near: RECIPE_NEAR,
            far: RECIPE_FAR,
            samples,
            last_interval: Some((RECIPE_FAR - RECIPE_NEAR) / samples.max(1) as f64),
        }
    }

    /// The same range with another number of samples.
    #[must_use]
    pub fn with_samples(self, samples: usize) -> Self {
        let last_interval = self.last_interval.map(|_| self.interval_of(samples));
        Self { samples, last_interval, ..self }
    }

    /// Refuses ranges and counts that cannot be sampled.
    pub fn validate(&self) -> Result<()> {
        if self.samples == 0 {
            return Err(Error::config("samples", "must be at least 1"));
        }
        if !(self.near.is_finite() && self.far.is_finite() && self.near < self.far) {
            return Err(Error::config("near", format!("{} must be below far, {}", self.near, self.far)));
        }
        match self.last_interval {
            Some(length) if !(length > 0.0 && length.is_finite()) => {
                Err(Error::config("last_interval", "must be a positive length"))
            }
            _ => Ok(()),
        }
    }

    /// Width of one of the equal intervals, world units along the view axis.
    pub fn interval(&self) -> f64 {
        self.interval_of(self.samples)
    }

    /// Width of the intervals if there were `samples` of them.
    pub fn interval_of(&self, samples: usize) -> f64 {
        (self.far - self.near) / samples.max(1) as f64
    }

    /// Depths without perturbation, `[1, 1, S]`: the same for every ray.
    pub fn regular(&self, dtype: DType, device: &Device) -> Result<Tensor> {
        let shift = match self.placement {
            Placement::Offset => 0.0,
            Placement::Stratified => 0.5,
        };
        self.depths(&Tensor::full(shift, (1, 1, 1), device)?.to_dtype(dtype)?)
    }

    /// Depths of `rays` rays of each of `batch` pictures, drawn from `random`: `[B, R, S]`, increasing along S.
    pub fn perturbed(
        &self,
        batch: usize,
        rays: usize,
        random: &mut Stream,
        dtype: DType,
        device: &Device,
    ) -> Result<Tensor> {
        let draws = match self.placement {
            Placement::Offset => 1,
            Placement::Stratified => self.samples,
        };
        self.depths(&random.uniform_tensor(&[batch, rays, draws], 0.0, 1.0, device)?.to_dtype(dtype)?)
    }

    /// Depths where each sample lies the share `shares` (in [0, 1], last dimension 1 or S) into its interval:
    /// `[.., S]`.
    pub fn depths(&self, shares: &Tensor) -> Result<Tensor> {
        self.validate()?;
        let interval = self.interval();
        let starts: Vec<f64> = (0..self.samples).map(|sample| self.near + interval * sample as f64).collect();
        let starts = Tensor::new(starts, shares.device())?.to_dtype(shares.dtype())?;
        Ok((shares * interval)?.broadcast_add(&starts)?)
    }

    /// Length of the interval that each of `depths` `[.., S]` stands for: up to the next sample, and
    /// `last_interval` for the last (0 if none: it takes what is left whatever its length). World units along the
    /// view axis, `[.., S]`.
    pub fn intervals(&self, depths: &Tensor) -> Result<Tensor> {
        let samples = depths.dim(D::Minus1)?;
        let last = depths.narrow(D::Minus1, 0, 1)?.zeros_like()?.affine(0.0, self.last_interval.unwrap_or(0.0))?;
        if samples == 1 {
            return Ok(last);
        }
        let next = depths.narrow(D::Minus1, 1, samples - 1)?;
        Ok(Tensor::cat(&[(next - depths.narrow(D::Minus1, 0, samples - 1)?)?, last], D::Minus1)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn regular_depths_are_the_authors_and_the_recipes() {
        let depths = |sampling: Sampling| -> Vec<f64> {
            let depths = sampling.regular(DType::F64, &Device::Cpu).unwrap();
            depths.flatten_all().unwrap().to_vec1().unwrap()
        };
        let close = |left: &[f64], right: &[f64]| left.iter().zip(right).all(|(a, b)| (a - b).abs() < 1e-12);
        assert!(close(&depths(Sampling::closed(4)), &[0.88, 0.94, 1.0, 1.06]));
        assert!(close(&depths(Sampling::behind_the_surface(2)), &[0.94625, 1.04875]));
    }

    #[test]
    fn perturbed_depths_stay_in_their_intervals_and_in_order() {
        for sampling in [Sampling::closed(6), Sampling::behind_the_surface(6)] {
            let mut random = Stream::new(3, &[]);
            let depths = sampling.perturbed(2, 50, &mut random, DType::F32, &Device::Cpu).unwrap();
            assert_eq!(depths.dims(), [2, 50, 6]);
            for ray in depths.flatten(0, 1).unwrap().to_vec2::<f32>().unwrap() {
                for (sample, depth) in ray.iter().enumerate() {
                    let start = sampling.near + sampling.interval() * sample as f64;
                    let share = (f64::from(*depth) - start) / sampling.interval();
                    assert!((-1e-5..1.0 + 1e-5).contains(&share), "{share}");
                }
                let gaps: Vec<f32> = ray.windows(2).map(|pair| pair[1] - pair[0]).collect();
                assert!(gaps.iter().all(|gap| *gap > 0.0));
                if sampling.placement == Placement::Offset {
                    assert!(gaps.iter().all(|gap| (gap - gaps[0]).abs() < 1e-6), "one offset for the whole ray");
                }
            }
        }
    }

    #[test]
    fn the_last_interval_is_what_it_is_told() {
        let depths = Tensor::new(&[[0.9f64, 1.0]], &Device::Cpu).unwrap();
        let last = |sampling: Sampling| sampling.intervals(&depths).unwrap().to_vec2::<f64>().unwrap()[0][1];
        assert_eq!(last(Sampling::authors(2)), 1e10);
        assert!((last(Sampling::behind_the_surface(2)) - 0.1025).abs() < 1e-12);
        assert!(Sampling { samples: 0, ..Sampling::closed(1) }.validate().is_err());
    }
}
