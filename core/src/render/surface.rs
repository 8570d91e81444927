//! Samples where the surface is, for pictures that nobody differentiates: distances at few regular depths tell where light
//! may come from, distances there tell where it does, and colours are evaluated there alone.
//!
//! First distances are evaluated for every other pixel of every other row and are straight lines between them, as long as
//! pixels are closer together than first samples; later samples, which are at the surface, are each ray's own.
//! Between its samples a ray's distance is a straight line, read at fine bins. Colours are straight lines too, from one
//! colour sample to the next, so a sample counts with the light of the bins it is nearest to, by the distances that
//! colour samples give on the way: twice the decibels of equal shares. Rays that no light can come from end early.

mod first_samples;

use candle_core::{D, DType, Device, Tensor};
use serde::{Deserialize, Serialize};

pub(super) use self::first_samples::FirstSamples;
use crate::{
    camera,
    error::{Error, Result},
    kernels::parts::Parts,
    region::RegionSet,
    render::{
        Evaluation, Outputs, Placement, RadianceField, RayBundle, RayOutput, RayWeights, Sampling, frame::background,
        integrate::aggregate,
    },
};

/// Rendering in passes, see [`RenderSettings::two_pass`](super::RenderSettings::two_pass).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TwoPass {
    /// Bins between which distances are interpolated.
    pub bins: usize,
    /// Distance samples per ray beyond the regular ones, where those say that light may come from.
    pub refinements: usize,
    /// Colour samples per ray, at the middles of equal shares of its light.
    pub colour_samples: usize,
}

impl Default for TwoPass {
    fn default() -> Self {
        Self { bins: 96, refinements: 2, colour_samples: 3 }
    }
}

impl TwoPass {
    /// The bins over the range of `sampling`.
    pub(super) fn bins_of(&self, sampling: &Sampling) -> Result<Sampling> {
        if self.bins == 0 || self.colour_samples == 0 {
            return Err(Error::config("two_pass", "bins and colour_samples must be at least 1"));
        }
        Ok(Sampling {
            placement: Placement::Stratified,
            samples: self.bins,
            last_interval: sampling.last_interval.map(|_| sampling.interval_of(self.bins)),
            ..*sampling
        })
    }
}

/// Rays that give less light than this, of 1, count as empty: half of what a screen shows.
const FAINT: f64 = 0.002;
/// How far cautious distances are from straight lines towards the least that they can be.
const CAUTION: f64 = 0.7;
/// Samples evaluated at once.
const POINTS_AT_ONCE: usize = 1 << 14;

/// What is known of one ray.
struct Probed {
    image: usize,
    ray: usize,
    /// World units per unit of depth.
    length: f64,
    /// (depth, signed distance), depths increasing.
    samples: Vec<(f64, f64)>,
}

impl Probed {
    fn insert(&mut self, depth: f64, distance: f64) {
        let place = self.samples.partition_point(|sample| sample.0 <= depth);
        self.samples.insert(place, (depth, distance));
    }

    /// The distance at increasing `depths` by straight lines, constant beyond the ends.
    fn straight(&self, depths: impl Iterator<Item = f64>) -> impl Iterator<Item = f64> {
        let mut right = 0;
        depths.map(move |depth| {
            while self.samples.get(right).is_some_and(|sample| sample.0 < depth) {
                right += 1;
            }
            let before = right.checked_sub(1).and_then(|left| self.samples.get(left));
            match (before, self.samples.get(right)) {
                (Some(from), Some(to)) => from.1 + (depth - from.0) / (to.0 - from.0).max(1e-12) * (to.1 - from.1),
                (Some(end), None) | (None, Some(end)) => end.1,
                (None, None) => f64::INFINITY,
            }
        })
    }

    /// [`CAUTION`] of the way from straight lines to the least that a distance, which changes by no more than one is moved,
    /// can be.
    fn cautious(&self, depths: impl Iterator<Item = f64> + Clone) -> impl Iterator<Item = f64> {
        let least = depths.clone().map(|depth| {
            let bounds = self.samples.iter().map(|sample| sample.1 - self.length * (depth - sample.0).abs());
            bounds.fold(f64::NEG_INFINITY, f64::max)
        });
        self.straight(depths).zip(least).map(|(straight, least)| straight + CAUTION * (least - straight))
    }
}

/// The light of rays' bins, and what is left behind them.
struct Light {
    bins: Vec<Vec<f64>>,
    remaining: Vec<f64>,
}

impl Light {
    fn of<F: RadianceField>(
        field: &F,
        fine: &Sampling,
        rays: &[Probed],
        cautious: bool,
        (dtype, device): (DType, &Device),
    ) -> Result<Self> {
        if rays.is_empty() {
            return Ok(Self { bins: Vec::new(), remaining: Vec::new() });
        }
        let bins = fine.samples;
        let depths = (0..bins).map(|bin| middle(fine, bin));
        let mut distances = Vec::with_capacity(rays.len() * bins);
        for ray in rays {
            if cautious {
                distances.extend(ray.cautious(depths.clone()));
            } else {
                distances.extend(ray.straight(depths.clone()));
            }
        }
        let tensor = |values: Vec<f64>, columns: usize| -> Result<Tensor> {
            Ok(Tensor::from_vec(values, (1, rays.len(), columns), device)?.to_dtype(dtype)?)
        };
        let lengths = tensor(rays.iter().map(|ray| ray.length).collect(), 1)?;
        let lengths = fine.intervals(&fine.regular(dtype, device)?)?.broadcast_mul(&lengths)?;
        let density = field.density(&tensor(distances, bins)?)?;
        let light = RayWeights::new(&density, &lengths, fine.last_interval.is_none())?;
        let numbers = |tensor: &Tensor| Ok::<_, Error>(tensor.to_dtype(DType::F64)?.squeeze(0)?);
        Ok(Self { bins: numbers(&light.weights)?.to_vec2()?, remaining: numbers(&light.remaining)?.to_vec1()? })
    }

    /// Light that comes from a ray.
    fn given(&self, ray: usize) -> f64 {
        1.0 - self.remaining.get(ray).copied().unwrap_or(1.0)
    }
}

/// Whether a ray's light is worth samples. What is not a number is: it must show.
fn is_lit(light: f64) -> bool {
    light > FAINT || light.is_nan()
}

/// The middle of a bin.
fn middle(fine: &Sampling, bin: usize) -> f64 {
    fine.near + fine.interval() * (bin as f64 + 0.5)
}

/// Pixels of `rays`, which are those of a picture from `first_ray` on, with colours at the surface; and how many samples it
/// took beyond the first, of distance alone or of everything.
pub(super) fn render_rays<F: RadianceField>(
    field: &F,
    rays: &RayBundle,
    (first, first_ray): (&FirstSamples, usize),
    (sampling, two_pass): (&Sampling, &TwoPass),
    outputs: Outputs,
    shown: RegionSet,
) -> Result<(RayOutput, usize)> {
    let (batch, count) = rays.dimensions()?;
    let (dtype, device) = (rays.directions.dtype(), rays.directions.device().clone());
    let fine = two_pass.bins_of(sampling)?;
    let light = |rays: &[Probed], cautious: bool| Light::of(field, &fine, rays, cautious, (dtype, &device));

    let mut lit = first.of(rays, first_ray)?;
    let mut samples = 0;
    if two_pass.refinements > 0 {
        let (likely, possible) = (light(&lit, false)?, light(&lit, true)?);
        let mut drawn = Vec::with_capacity(lit.len());
        let mut index = 0;
        lit.retain(|_| {
            let keep = is_lit(likely.given(index)) || is_lit(possible.given(index));
            if let (true, Some(likely), Some(possible)) = (keep, likely.bins.get(index), possible.bins.get(index)) {
                let light: Vec<f64> = likely.iter().zip(possible).map(|(sure, may)| sure + may).collect();
                drawn.extend(quantiles_of_ray(&light, &fine, two_pass.refinements));
            }
            index += 1;
            keep
        });
        samples += drawn.len();
        Places::new(&lit, &drawn, batch).evaluate_distances(field, rays, &mut lit, &drawn)?;
    }
    let likely = light(&lit, false)?;
    let mut drawn = Vec::with_capacity(lit.len() * two_pass.colour_samples);
    let mut index = 0;
    lit.retain(|_| {
        let bins = likely.bins.get(index).filter(|_| is_lit(likely.given(index)));
        drawn.extend(bins.into_iter().flat_map(|bins| quantiles_of_ray(bins, &fine, two_pass.colour_samples)));
        index += 1;
        bins.is_some()
    });
    samples += drawn.len();
    let places = Places::new(&lit, &drawn, batch);
    let evaluation = places.evaluate(field, rays, &drawn, outputs)?;
    if let Some(evaluation) = &evaluation {
        places.insert(&evaluation.distance, &mut lit, &drawn)?;
    }
    let light = light(&lit, false)?;

    // Back to all rays: those without a sample have no weight, and their samples are zeros.
    let colour_samples = two_pass.colour_samples;
    let mut weights = vec![0.0; batch * count * colour_samples];
    let mut remaining = vec![1.0; batch * count];
    let mut colour_depths = vec![fine.near; batch * count * colour_samples];
    for (index, ray) in lit.iter().enumerate() {
        let row = ray.image * count + ray.ray;
        let own = index * colour_samples..(index + 1) * colour_samples;
        let (Some(drawn), Some(bins)) = (drawn.get(own), light.bins.get(index)) else { continue };
        let range = row * colour_samples..(row + 1) * colour_samples;
        if let Some(depths) = colour_depths.get_mut(range.clone()) {
            depths.copy_from_slice(drawn);
        }
        if let (Some(weights), Some(left)) = (weights.get_mut(range), light.remaining.get(index)) {
            share_out(bins, &fine, drawn, weights);
            remaining[row] = *left;
        }
    }
    let tensor = |values: Vec<f64>, columns: usize| -> Result<Tensor> {
        Ok(Tensor::from_vec(values, (batch, count, columns), &device)?.to_dtype(dtype)?)
    };
    let weights =
        RayWeights { weights: tensor(weights, colour_samples)?, remaining: tensor(remaining, 1)?.squeeze(D::Minus1)? };
    let colour_depths = tensor(colour_depths, colour_samples)?;
    let evaluation = match evaluation {
        Some(evaluation) => places.spread(&evaluation, &lit, (count, colour_samples))?,
        // Nothing to be seen: any samples do.
        None => {
            let view = if field.sees_view() { Some(rays.view_directions_of(colour_samples)?) } else { None };
            field.evaluate(&rays.points(&colour_depths)?, view.as_ref(), outputs)?
        }
    };
    let behind = background(field, rays, outputs)?;
    let output = aggregate(field, rays, &colour_depths, weights, evaluation, behind.as_ref(), shown)?;
    Ok((output, samples))
}

/// Samples of some rays, the same number of each, as one list a picture, padded to the longest.
struct Places {
    /// Per picture, the ray of every sample.
    rays: Vec<Vec<u32>>,
    /// Samples of a ray.
    per_ray: usize,
    longest: usize,
}

impl Places {
    fn new(lit: &[Probed], drawn: &[f64], batch: usize) -> Self {
        let per_ray = drawn.len() / lit.len().max(1);
        let mut rays = vec![Vec::new(); batch];
        for probed in lit {
            if let Some(list) = rays.get_mut(probed.image) {
                list.extend(std::iter::repeat_n(probed.ray as u32, per_ray));
            }
        }
        let longest = rays.iter().map(Vec::len).max().unwrap_or(0);
        Self { rays, per_ray, longest }
    }

    /// The field at depths `drawn`; none if there are none.
    fn evaluate<F: RadianceField>(
        &self,
        field: &F,
        rays: &RayBundle,
        drawn: &[f64],
        outputs: Outputs,
    ) -> Result<Option<Evaluation>> {
        if self.longest == 0 {
            return Ok(None);
        }
        let (dtype, device) = (rays.directions.dtype(), rays.directions.device());
        let (mut points, mut views) = (Vec::new(), Vec::new());
        let mut drawn = drawn.iter();
        for (image, list) in self.rays.iter().enumerate() {
            let mut indices = list.clone();
            indices.resize(self.longest, 0);
            let indices = Tensor::from_vec(indices, self.longest, device)?;
            let mut depths: Vec<f64> = drawn.by_ref().take(list.len()).copied().collect();
            depths.resize(self.longest, camera::NEAR);
            let depths = Tensor::from_vec(depths, (self.longest, 1), device)?.to_dtype(dtype)?;
            let of = |tensor: &Tensor| -> Result<Tensor> {
                Ok(tensor.narrow(0, image, 1)?.squeeze(0)?.contiguous()?.index_select(&indices, 0)?)
            };
            let origin = rays.origins.narrow(0, image, 1)?.squeeze(0)?;
            points.push(of(&rays.directions)?.broadcast_mul(&depths)?.broadcast_add(&origin)?);
            views.push(of(&rays.view_directions)?);
        }
        let views = if field.sees_view() { Some(Tensor::stack(&views, 0)?) } else { None };
        field.evaluate(&Tensor::stack(&points, 0)?, views.as_ref(), outputs).map(Some)
    }

    fn evaluate_distances<F: RadianceField>(
        &self,
        field: &F,
        rays: &RayBundle,
        lit: &mut [Probed],
        drawn: &[f64],
    ) -> Result<()> {
        match self.evaluate(field, rays, drawn, Outputs::default())? {
            Some(evaluation) => self.insert(&evaluation.distance, lit, drawn),
            None => Ok(()),
        }
    }

    /// Adds `distance` `[B, M]` at depths `drawn` to what is known of the rays.
    fn insert(&self, distance: &Tensor, lit: &mut [Probed], drawn: &[f64]) -> Result<()> {
        let distance: Vec<Vec<f64>> = distance.to_dtype(DType::F64)?.to_vec2()?;
        let known = distance.iter().zip(&self.rays).flat_map(|(row, list)| row.iter().take(list.len()));
        let mut known = drawn.iter().zip(known);
        for probed in lit {
            for (depth, distance) in known.by_ref().take(self.per_ray) {
                probed.insert(*depth, *distance);
            }
        }
        Ok(())
    }

    /// An evaluation of the lists as one of `per_ray` samples of every ray, zeros where there is none.
    fn spread(&self, lists: &Evaluation, lit: &[Probed], (count, per_ray): (usize, usize)) -> Result<Evaluation> {
        let device = lists.distance.device();
        // Where each sample of each picture is in its list; behind the list's end are zeros.
        let mut columns = vec![vec![self.longest as u32; count * per_ray]; self.rays.len()];
        let mut filled = vec![0u32; self.rays.len()];
        for probed in lit {
            let own = probed.ray * per_ray..(probed.ray + 1) * per_ray;
            if let (Some(row), Some(next)) = (columns.get_mut(probed.image), filled.get_mut(probed.image)) {
                for column in row.get_mut(own).into_iter().flatten() {
                    *column = *next;
                    *next += 1;
                }
            }
        }
        let columns =
            columns.into_iter().map(|row| Tensor::new(row, device)).collect::<candle_core::Result<Vec<_>>>()?;
        let spread = |lists: &Tensor| -> Result<Tensor> {
            let last = lists.rank() - 1;
            let padded = lists.pad_with_zeros(last, 0, 1)?;
            let images = columns.iter().enumerate();
            let images =
                images.map(|(image, columns)| padded.narrow(0, image, 1)?.contiguous()?.index_select(columns, last));
            Ok(Tensor::cat(&images.collect::<candle_core::Result<Vec<_>>>()?, 0)?)
        };
        let optional = |lists: &Option<Tensor>| lists.as_ref().map(spread).transpose();
        Ok(Evaluation {
            distance: spread(&lists.distance)?,
            masks: spread(&lists.masks)?,
            residuals: spread(&lists.residuals)?,
            colours: optional(&lists.colours)?,
            activations: lists
                .activations
                .as_ref()
                .map(|lists| Ok::<_, Error>(Parts::new(spread(&lists.tensor()?)?)?))
                .transpose()?,
            gradient: optional(&lists.gradient)?,
        })
    }
}

/// The light of every bin goes to the samples at increasing depths `drawn`: to the two around it by how near they are.
fn share_out(bins: &[f64], fine: &Sampling, drawn: &[f64], weights: &mut [f64]) {
    let mut right = 0;
    for (bin, light) in bins.iter().enumerate() {
        let depth = middle(fine, bin);
        while drawn.get(right).is_some_and(|sample| *sample < depth) {
            right += 1;
        }
        let left = right.saturating_sub(1);
        let end = right.min(drawn.len().saturating_sub(1));
        let share = match (drawn.get(left), drawn.get(end)) {
            (Some(from), Some(to)) if to > from => ((depth - from) / (to - from)).clamp(0.0, 1.0),
            _ => 0.0,
        };
        if let Some(weight) = weights.get_mut(left) {
            *weight += light * (1.0 - share);
        }
        if let Some(weight) = weights.get_mut(end) {
            *weight += light * share;
        }
    }
}

/// Depths in the middle of `count` equal shares of a ray's light, which comes from `bins`.
pub(super) fn quantiles_of_ray(light: &[f64], bins: &Sampling, count: usize) -> impl Iterator<Item = f64> {
    // A trace of light everywhere spreads the samples of rays that meet nothing.
    const TRACE: f64 = 1e-6;
    let total: f64 = light.iter().map(|weight| weight + TRACE).sum();
    let (near, interval) = (bins.near, bins.interval());
    let (mut bin, mut passed) = (0, 0.0);
    (0..count).map(move |share| {
        let wanted = (share as f64 + 0.5) / count as f64 * total;
        let here = |bin: usize| light.get(bin).map_or(0.0, |weight| weight + TRACE);
        while passed + here(bin) < wanted && bin + 1 < light.len() {
            passed += here(bin);
            bin += 1;
        }
        let within = ((wanted - passed) / here(bin).max(1e-9)).clamp(0.0, 1.0);
        near + interval * (bin as f64 + within)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_is_shared_out_whole_and_by_nearness() {
        let fine = TwoPass { bins: 4, ..TwoPass::default() }.bins_of(&Sampling::behind_the_surface(8)).unwrap();
        let at = |bin: f64| fine.near + fine.interval() * (bin + 0.5);
        let mut weights = [0.0; 2];
        // A bin before the first sample, one on it, one half way to the second, one behind it.
        share_out(&[0.1, 0.2, 0.3, 0.4], &fine, &[at(1.0), at(3.0) - 1e-9], &mut weights);
        assert!((weights[0] - 0.45).abs() < 1e-6 && (weights[1] - 0.55).abs() < 1e-6, "{weights:?}");
        let mut alone = [0.0];
        share_out(&[0.1, 0.2, 0.3, 0.4], &fine, &[at(2.0)], &mut alone);
        assert!((alone[0] - 1.0).abs() < 1e-12, "{alone:?}");
    }

    #[test]
    fn lines_pass_through_their_samples_and_caution_never_adds() {
        let mut ray = Probed { image: 0, ray: 0, length: 1.1, samples: vec![(0.9, 0.05), (1.0, -0.02)] };
        ray.insert(0.95, 0.01);
        let depths = [0.8, 0.9, 0.925, 0.95, 1.0, 1.1];
        let straight: Vec<f64> = ray.straight(depths.into_iter()).collect();
        for (found, expected) in straight.iter().zip([0.05, 0.05, 0.03, 0.01, -0.02, -0.02]) {
            assert!((found - expected).abs() < 1e-12, "{straight:?}");
        }
        for (cautious, straight) in ray.cautious(depths.into_iter()).zip(straight) {
            assert!(cautious <= straight + 1e-12);
        }
    }

    #[test]
    fn quantiles_lie_where_the_light_is() {
        let fine = TwoPass { bins: 5, ..TwoPass::default() }.bins_of(&Sampling::behind_the_surface(8)).unwrap();
        let found: Vec<f64> = quantiles_of_ray(&[0.0, 0.5, 0.0, 0.5, 0.0], &fine, 2).collect();
        let middles = [1.5, 3.5].map(|bin| fine.near + fine.interval() * bin);
        assert!(found.iter().zip(middles).all(|(found, middle)| (found - middle).abs() < 1e-5), "{found:?}");
    }
}
