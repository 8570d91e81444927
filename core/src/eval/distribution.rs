//! How far apart two sets of pictures are, judged by feature vectors: Fréchet distance, kernel distance, precision and
//! recall.
//!
//! Everything is computed in f64 and in a fixed order. The numbers depend on the features: those of LPIPS backbones
//! (see [`super::features`]) are not comparable with the Inception features of published tables.

use nalgebra::DMatrix;

use crate::{
    error::{Error, Result},
    rng::Stream,
};

/// The neighbour whose distance is the radius of a sample's ball (Kynkäänniemi et al., 2019).
const NEIGHBOUR: usize = 3;
/// Shares of both sets at which the Fréchet distance is taken to be extrapolated.
const SHARES: [f64; 6] = [0.4, 0.5, 0.6, 0.7, 0.85, 1.0];
/// Draws of each share below 1, averaged.
const DRAWS: u64 = 3;
/// The first element of every stream drawn here.
const STREAM: u64 = 0x4644;

/// Feature vectors of a set of pictures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FeatureSet {
    length: usize,
    rows: Vec<f64>,
}

impl FeatureSet {
    /// An empty set of vectors of `length` numbers.
    pub fn new(length: usize) -> Self {
        Self { length, rows: Vec::new() }
    }

    /// Adds a vector.
    ///
    /// # Errors
    /// [`Error::Shape`] for another length, [`Error::NotFinite`] for NaN or infinity.
    pub fn push(&mut self, vector: &[f64]) -> Result<()> {
        if vector.len() != self.length {
            return Err(Error::shape("feature vector", [self.length], &[vector.len()]));
        }
        if !vector.iter().all(|value| value.is_finite()) {
            return Err(Error::not_finite("a picture's features"));
        }
        self.rows.extend_from_slice(vector);
        Ok(())
    }

    /// Number of vectors.
    pub fn len(&self) -> usize {
        self.rows.len() / self.length.max(1)
    }

    /// Whether there is no vector.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Numbers in a vector.
    pub fn length(&self) -> usize {
        self.length
    }

    /// The vectors in the order they were added.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = &[f64]> {
        self.rows.chunks_exact(self.length.max(1))
    }

    /// Every second vector, and the others.
    pub fn halves(&self) -> (Self, Self) {
        let half = |parity: usize| {
            let rows = self.rows().skip(parity).step_by(2).flatten().copied().collect();
            Self { length: self.length, rows }
        };
        (half(0), half(1))
    }

    /// `count` different vectors, drawn from `random`.
    fn draw(&self, count: usize, random: &mut Stream) -> Self {
        let order = random.permutation(self.len());
        let rows =
            order.into_iter().take(count).filter_map(|index| self.rows().nth(index)).flatten().copied().collect();
        Self { length: self.length, rows }
    }

    fn mean(&self) -> Vec<f64> {
        let mut mean = vec![0.0; self.length];
        for row in self.rows() {
            for (sum, value) in mean.iter_mut().zip(row) {
                *sum += value;
            }
        }
        let count = self.len().max(1) as f64;
        mean.into_iter().map(|sum| sum / count).collect()
    }

    /// A with AᵀA the unbiased covariance: centred rows over √(n − 1), `[n, length]`.
    fn centred(&self, mean: &[f64]) -> DMatrix<f64> {
        let scale = 1.0 / ((self.len().max(2) - 1) as f64).sqrt();
        let centred = self.rows().flat_map(|row| row.iter().zip(mean).map(|(value, mean)| (value - mean) * scale));
        DMatrix::from_row_iterator(self.len(), self.length, centred)
    }
}

fn check(a: &FeatureSet, b: &FeatureSet, least: usize) -> Result<()> {
    if a.length != b.length {
        return Err(Error::shape("features to compare", [a.length], &[b.length]));
    }
    for set in [a, b] {
        if set.len() < least {
            return Err(Error::config(
                "--count",
                format!("{} pictures are too few, at least {least} needed", set.len()),
            ));
        }
    }
    Ok(())
}

/// Fréchet distance of the Gaussians with both sets' means and unbiased covariances (Heusel et al., 2017):
/// |μ₁ − μ₂|² + tr Σ₁ + tr Σ₂ − 2 tr (Σ₁Σ₂)^½.
///
/// The last trace is Σ √λ of LᵀΣ₂L for any L with Σ₁ = LLᵀ: a symmetric problem, no larger than the smaller set. Of
/// finite sets the distance is too large on average, the more so the fewer pictures: see [`extrapolated_frechet`].
///
/// # Errors
/// [`Error::Config`] for fewer than two vectors, [`Error::Shape`] for sets of different features.
pub fn frechet_distance(a: &FeatureSet, b: &FeatureSet) -> Result<f64> {
    check(a, b, 2)?;
    let (small, large) = if a.len() <= b.len() { (a, b) } else { (b, a) };
    let (small_mean, large_mean) = (small.mean(), large.mean());
    let (small, large) = (small.centred(&small_mean), large.centred(&large_mean));
    let means: f64 = small_mean.iter().zip(&large_mean).map(|(a, b)| (a - b).powi(2)).sum();
    let traces = small.norm_squared() + large.norm_squared();
    let factor = if small.nrows() <= small.ncols() { small.transpose() } else { symmetric_root(small.tr_mul(&small)) };
    let product = &large * factor;
    let roots: f64 = product.tr_mul(&product).symmetric_eigenvalues().iter().map(|value| value.max(0.0).sqrt()).sum();
    // Rounding may take equal sets a little below 0.
    Ok((means + traces - 2.0 * roots).max(0.0))
}

/// A matrix L with LLᵀ = `covariance`.
fn symmetric_root(covariance: DMatrix<f64>) -> DMatrix<f64> {
    let eigen = covariance.symmetric_eigen();
    let mut root = eigen.eigenvectors;
    for (mut column, value) in root.column_iter_mut().zip(eigen.eigenvalues.iter()) {
        column *= value.max(0.0).sqrt();
    }
    root
}

/// Fréchet distance of infinitely many pictures (FID∞, Chong and Forsyth, 2020): the distance is taken at shares of
/// both sets, where it is linear in one over the share, and the line is followed to 0. None if a set has fewer vectors
/// than numbers in a vector: covariances are then singular and there is no line.
pub fn extrapolated_frechet(a: &FeatureSet, b: &FeatureSet, seed: u64) -> Result<Option<f64>> {
    check(a, b, 2)?;
    if a.len().min(b.len()) < a.length {
        return Ok(None);
    }
    let mut points = Vec::new();
    for (index, share) in SHARES.into_iter().enumerate() {
        let count = |set: &FeatureSet| ((share * set.len() as f64).round() as usize).clamp(2, set.len());
        let draws = if share < 1.0 { DRAWS } else { 1 };
        let mut sum = 0.0;
        for draw in 0..draws {
            let mut random = Stream::new(seed, &[STREAM, index as u64, draw]);
            sum += frechet_distance(&a.draw(count(a), &mut random), &b.draw(count(b), &mut random))?;
        }
        points.push((1.0 / share, sum / draws as f64));
    }
    let count = points.len() as f64;
    let (x, y) = points.iter().fold((0.0, 0.0), |(x, y), point| (x + point.0 / count, y + point.1 / count));
    let slope = points.iter().map(|point| (point.0 - x) * (point.1 - y)).sum::<f64>()
        / points.iter().map(|point| (point.0 - x).powi(2)).sum::<f64>();
    Ok(Some((y - slope * x).max(0.0)))
}

/// Kernel distance (KID, Bińkowski et al., 2018): the unbiased estimate of the squared maximum mean discrepancy under
/// the kernel (x·y / length + 1)³, over all pairs of both sets. Its mean does not depend on the number of pictures; of
/// equal distributions it is 0 on average and may be negative.
///
/// # Errors
/// As [`frechet_distance`].
pub fn kernel_distance(a: &FeatureSet, b: &FeatureSet) -> Result<f64> {
    check(a, b, 2)?;
    let length = a.length.max(1) as f64;
    let kernel = |x: &[f64], y: &[f64]| (x.iter().zip(y).map(|(x, y)| x * y).sum::<f64>() / length + 1.0).powi(3);
    let within = |set: &FeatureSet| {
        let pairs = set.rows().enumerate().map(|(index, x)| set.rows().take(index).map(|y| kernel(x, y)).sum::<f64>());
        let count = set.len() as f64;
        2.0 * pairs.sum::<f64>() / (count * (count - 1.0))
    };
    let across: f64 = a.rows().map(|x| b.rows().map(|y| kernel(x, y)).sum::<f64>()).sum();
    Ok(within(a) + within(b) - 2.0 * across / (a.len() as f64 * b.len() as f64))
}

/// How much of either set lies in the other (Kynkäänniemi et al., 2019).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PrecisionRecall {
    /// Share of the generated that lie among the real: high if pictures are realistic.
    pub precision: f64,
    /// Share of the real that lie among the generated: high if pictures are varied.
    pub recall: f64,
}

/// Precision and recall: a picture lies among a set if it is in the ball of one of its members, which reaches to the
/// member's third neighbour.
///
/// # Errors
/// [`Error::Config`] for fewer than five vectors, [`Error::Shape`] for sets of different features.
pub fn precision_recall(real: &FeatureSet, generated: &FeatureSet) -> Result<PrecisionRecall> {
    check(real, generated, NEIGHBOUR + 2)?;
    let distance = |x: &[f64], y: &[f64]| x.iter().zip(y).map(|(x, y)| (x - y).powi(2)).sum::<f64>();
    let radii = |set: &FeatureSet| -> Vec<f64> {
        let radius = |(index, x): (usize, &[f64])| {
            let others = set.rows().enumerate().filter(|(other, _)| *other != index);
            let mut distances: Vec<f64> = others.map(|(_, y)| distance(x, y)).collect();
            *distances.select_nth_unstable_by(NEIGHBOUR - 1, f64::total_cmp).1
        };
        set.rows().enumerate().map(radius).collect()
    };
    let covered = |set: &FeatureSet, by: &FeatureSet| {
        let radii = radii(by);
        let lies_among = |x: &&[f64]| by.rows().zip(&radii).any(|(y, radius)| distance(x, y) <= *radius);
        set.rows().filter(lies_among).count() as f64 / set.len() as f64
    };
    Ok(PrecisionRecall { precision: covered(generated, real), recall: covered(real, generated) })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Normal vectors, every number with a deviation of its own.
    fn normals(seed: u64, count: usize, length: usize) -> FeatureSet {
        let mut random = Stream::new(seed, &[]);
        let mut set = FeatureSet::new(length);
        for _ in 0..count {
            let row: Vec<f64> =
                (0..length).map(|index| f64::from(random.normal()) * (1.0 + index as f64 / length as f64)).collect();
            set.push(&row).unwrap();
        }
        set
    }

    fn mapped(set: &FeatureSet, map: impl Fn(usize, f64) -> f64) -> FeatureSet {
        let rows = set.rows.iter().enumerate().map(|(index, value)| map(index % set.length, *value)).collect();
        FeatureSet { length: set.length, rows }
    }

    #[test]
    fn a_shifted_and_scaled_set_is_as_far_as_the_closed_form_says() {
        // Fewer vectors than numbers, and more: both ways of finding the factor.
        for count in [7, 200] {
            let set = normals(1, count, 20);
            let trace = set.centred(&set.mean()).norm_squared();
            let mean = set.mean();
            for (scale, shift) in [(1.0, 0.0), (1.0, 0.3), (2.5, 0.0), (0.2, -1.0)] {
                let other = mapped(&set, |index, value| scale * value + shift * index as f64);
                let means: f64 = mean
                    .iter()
                    .enumerate()
                    .map(|(index, mean)| ((scale - 1.0) * mean + shift * index as f64).powi(2))
                    .sum();
                let expected = means + (scale - 1.0).powi(2) * trace;
                for found in [frechet_distance(&set, &other).unwrap(), frechet_distance(&other, &set).unwrap()] {
                    // Null directions have eigenvalues of 1e-15 instead of 0, whose roots are 3e-8.
                    assert!((found - expected).abs() < 1e-5 * trace, "{count} {scale} {shift}: {found} {expected}");
                }
            }
        }
    }

    #[test]
    fn commuting_covariances_have_a_closed_form() {
        // Numbers on both sides of 0 make an exactly diagonal covariance: Σ = diag(2 sᵢ² / (n - 1)).
        let diagonal = |deviations: &[f64]| {
            let mut set = FeatureSet::new(deviations.len());
            for (index, deviation) in deviations.iter().enumerate() {
                for sign in [-1.0, 1.0] {
                    let mut row = vec![0.0; deviations.len()];
                    row[index] = sign * deviation;
                    set.push(&row).unwrap();
                }
            }
            set
        };
        let (a, b) = ([1.0, 2.0, 0.5], [3.0, 0.1, 0.5]);
        let expected: f64 = a.iter().zip(&b).map(|(a, b): (&f64, &f64)| (a - b).powi(2) * 2.0 / 5.0).sum();
        let found = frechet_distance(&diagonal(&a), &diagonal(&b)).unwrap();
        assert!((found - expected).abs() < 1e-10, "{found} {expected}");
    }

    #[test]
    fn kernel_distance_of_one_distribution_is_zero_on_average_at_any_count() {
        for count in [4, 40] {
            let distances: Vec<f64> = (0..200)
                .map(|draw| {
                    kernel_distance(&normals(1000 + 2 * draw, count, 5), &normals(1001 + 2 * draw, count, 5)).unwrap()
                })
                .collect();
            let mean = distances.iter().sum::<f64>() / 200.0;
            let variance = distances.iter().map(|distance| (distance - mean).powi(2)).sum::<f64>() / 199.0;
            // Within three standard errors; a biased estimate (diagonal pairs counted) is off by more than ten.
            assert!(mean.abs() < 3.0 * (variance / 200.0).sqrt(), "{count}: {mean} ± {}", (variance / 200.0).sqrt());
        }
        // A shift is seen.
        let set = normals(3, 100, 5);
        assert!(kernel_distance(&normals(4, 100, 5), &mapped(&set, |_, value| value + 1.0)).unwrap() > 1.0);
    }

    #[test]
    fn kernel_distance_agrees_with_its_definition() {
        let set = |rows: [[f64; 2]; 2]| FeatureSet { length: 2, rows: rows.concat() };
        let (a, b) = (set([[1.0, 0.0], [0.0, 2.0]]), set([[1.0, 1.0], [2.0, 0.0]]));
        // Within a: x·y = 0, so 1. Within b: (2/2 + 1)³ = 8. Across: 1/2, 1, 1, 0 over 2... each plus one, cubed.
        let across = (1.5f64.powi(3) + 2f64.powi(3) + 2f64.powi(3) + 1.0) / 4.0;
        assert!((kernel_distance(&a, &b).unwrap() - (1.0 + 8.0 - 2.0 * across)).abs() < 1e-12);
    }

    #[test]
    fn extrapolation_removes_most_of_the_bias() {
        let (a, b) = (normals(5, 240, 12), normals(6, 240, 12));
        let plain = frechet_distance(&a, &b).unwrap();
        let corrected = extrapolated_frechet(&a, &b, 0).unwrap().unwrap();
        assert!(plain > 0.3 && corrected < 0.5 * plain, "{plain} {corrected}");
        assert_eq!(extrapolated_frechet(&normals(1, 5, 12), &b, 0).unwrap(), None);
        assert_eq!(extrapolated_frechet(&a, &b, 0).unwrap(), Some(corrected));
    }

    #[test]
    fn precision_and_recall_tell_quality_from_variety() {
        let real = normals(7, 300, 2);
        let same = precision_recall(&real, &normals(8, 300, 2)).unwrap();
        assert!(same.precision > 0.8 && same.recall > 0.8, "{same:?}");
        let narrow = precision_recall(&real, &mapped(&normals(8, 300, 2), |_, value| 0.1 * value)).unwrap();
        assert!(narrow.precision > 0.95 && narrow.recall < 0.3, "{narrow:?}");
        let far = precision_recall(&real, &mapped(&normals(8, 300, 2), |_, value| value + 100.0)).unwrap();
        assert_eq!((far.precision, far.recall), (0.0, 0.0));
    }

    #[test]
    fn what_cannot_be_compared_is_refused() {
        let set = normals(1, 4, 3);
        assert!(frechet_distance(&set, &normals(1, 4, 2)).is_err());
        assert!(kernel_distance(&set, &normals(1, 1, 3)).unwrap_err().to_string().contains("--count"));
        assert!(precision_recall(&set, &set).is_err());
        assert!(FeatureSet::new(2).push(&[f64::NAN, 0.0]).is_err() && FeatureSet::new(2).push(&[0.0]).is_err());
    }
}
