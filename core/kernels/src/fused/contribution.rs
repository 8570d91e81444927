//! Which points a backward pass may leave out.
//!
//! Along a ray only the samples near the surface count, and of its regions those that are there: most upstream gradients
//! are 0 or next to it. Left out are the points whose gradients together make up at most [`NEGLIGIBLE`] of all.

use std::ops::Range;

use rayon::prelude::*;

/// Share of the upstream gradients' sum of magnitudes that may be left out: rounding in f32 takes as much.
const NEGLIGIBLE: f64 = 1e-6;
/// Points of a task.
const TASK: usize = 4096;
/// Values of an f32's exponent.
const EXPONENTS: usize = 256;

/// How much every point of every (image, region) contributes to the gradients of weights, FiLM and points.
pub struct Contribution {
    points: usize,
    /// Exponents of the contributions, `[images · regions, points]`.
    exponents: Vec<u8>,
    /// Points with an exponent below this are left out.
    least: u8,
}

impl Contribution {
    /// Of the upstream gradient `[pairs, rows, points]`. A point contributes the sum of its rows' magnitudes, each row as
    /// a share of the same row's sum over all points: rows differ in size by orders.
    pub fn new(pairs: usize, rows: usize, points: usize, upstream: &[f32]) -> Self {
        let total = |row: usize| -> f64 {
            let of_row = (0..pairs).into_par_iter().map(|pair| {
                let values = &upstream[(pair * rows + row) * points..][..points];
                values.chunks(TASK).map(|values| f64::from(magnitude(values))).sum::<f64>()
            });
            of_row.collect::<Vec<_>>().iter().sum()
        };
        // Sums that are not finite leave nothing out, so that whoever looks for such gradients finds them.
        let totals: Vec<f64> = (0..rows).map(total).collect();
        let mut exponents = vec![0u8; pairs * points];
        let tasks = points.div_ceil(TASK).max(1);
        let histograms: Vec<Vec<f64>> = exponents
            .par_chunks_mut(points.max(1))
            .enumerate()
            .flat_map_iter(|(pair, exponents)| {
                exponents.chunks_mut(TASK).enumerate().map(move |(task, exponents)| (pair, task, exponents))
            })
            .map(|(pair, task, exponents)| {
                let mut sums = [0f32; TASK];
                let sums = &mut sums[..exponents.len()];
                for (row, total) in totals.iter().enumerate().filter(|(_, total)| **total > 0.0) {
                    let scale = (1.0 / total) as f32;
                    let values = &upstream[(pair * rows + row) * points + task * TASK..][..exponents.len()];
                    sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += value.abs() * scale);
                }
                let mut histogram = vec![0f64; EXPONENTS];
                for (exponent, sum) in exponents.iter_mut().zip(sums) {
                    *exponent = (sum.to_bits() >> 23) as u8;
                    histogram[usize::from(*exponent)] += f64::from(*sum);
                }
                histogram
            })
            .collect();
        debug_assert_eq!(histograms.len(), pairs * tasks);
        let finite = totals.iter().all(|total| total.is_finite());
        let least = if finite { least(&histograms, totals.iter().filter(|total| **total > 0.0).count()) } else { 0 };
        Self { points, exponents, least }
    }

    /// The points of `range` of a pair that count, in order.
    pub fn list(&self, pair: usize, range: Range<usize>, indices: &mut Vec<u32>) {
        indices.clear();
        let exponents = &self.exponents[pair * self.points..][range.clone()];
        let all = range.zip(exponents);
        indices.extend(all.filter(|(_, exponent)| **exponent >= self.least).map(|(index, _)| index as u32));
    }
}

/// The least exponent that counts: those below it sum to at most a share [`NEGLIGIBLE`] of all, which is `total`.
fn least(histograms: &[Vec<f64>], total: usize) -> u8 {
    let mut left_out = 0.0;
    for exponent in 0..EXPONENTS {
        left_out += histograms.iter().map(|histogram| histogram[exponent]).sum::<f64>();
        if left_out > NEGLIGIBLE * total as f64 {
            return exponent as u8;
        }
    }
    // Nothing at all flows back.
    u8::MAX
}

/// Σ |value| in eight sums side by side.
fn magnitude(values: &[f32]) -> f32 {
    let mut lanes = [0f32; 8];
    let values = values.chunks_exact(8);
    let rest: f32 = values.remainder().iter().map(|value| value.abs()).sum();
    for values in values {
        lanes.iter_mut().zip(values).for_each(|(lane, value)| *lane += value.abs());
    }
    lanes.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listed(contribution: &Contribution, pair: usize) -> Vec<u32> {
        let mut indices = Vec::new();
        contribution.list(pair, 0..contribution.points, &mut indices);
        indices
    }

    #[test]
    fn what_is_left_out_sums_to_next_to_nothing() {
        // Two pairs, two rows of very different size, magnitudes over thirty orders.
        let (points, scales) = (9000, [1e6f32, 1e-6]);
        let mut upstream = vec![0f32; 2 * 2 * points];
        for (place, value) in upstream.iter_mut().enumerate() {
            let point = place % points;
            let sign = if point % 2 == 0 { 1.0 } else { -1.0 };
            *value = sign * scales[place / points % 2] * 10f32.powi(-((point % 30) as i32));
        }
        let contribution = Contribution::new(2, 2, points, &upstream);
        let kept = listed(&contribution, 1);
        assert!(kept.len() < points / 3, "{} of {points} points", kept.len());
        for row in 0..2 {
            let magnitude = |point: usize| f64::from(upstream[(2 + row) * points + point].abs());
            let all: f64 = (0..points).map(magnitude).sum();
            let found: f64 = kept.iter().map(|point| magnitude(*point as usize)).sum();
            assert!(1.0 - found / all < 2e-6, "row {row}: {:e}", 1.0 - found / all);
        }
    }

    #[test]
    fn zeros_are_left_out_and_what_is_not_finite_never_is() {
        let mut upstream = vec![0f32; 3 * 100];
        upstream[205] = 1e-30;
        let contribution = Contribution::new(3, 1, 100, &upstream);
        assert!(listed(&contribution, 0).is_empty() && listed(&contribution, 1).is_empty());
        assert_eq!(listed(&contribution, 2), [5]);
        upstream[7] = f32::NAN;
        let contribution = Contribution::new(3, 1, 100, &upstream);
        assert!(listed(&contribution, 0).contains(&7) && listed(&contribution, 2).contains(&5));
        assert!(listed(&Contribution::new(1, 1, 4, &[0.0; 4]), 0).is_empty());
        assert!(listed(&Contribution::new(1, 2, 0, &[]), 0).is_empty());
    }
}
