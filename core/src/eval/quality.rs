//! Measures of pictures and masks: PSNR, SSIM, MS-SSIM, agreement of regions, sharpness, locality of a change.
//!
//! Pictures are tensors `[B, C, H, W]` in [-1, 1]; everything is computed in f64 after mapping them to [0, 1], and
//! returned per picture.

use candle_core::{DType, Device, Tensor};

use crate::{
    data::labels::LabelMap,
    error::{Error, Result},
    region::{REGION_COUNT, Region, RegionSet},
};

/// PSNR reported of equal pictures, dB: a number where the formula has none, so that reports stay plain numbers.
pub const MAX_PSNR_DB: f64 = 100.0;
/// Width of SSIM's Gaussian window, pixels (Wang et al., 2004).
const WINDOW: usize = 11;
/// Standard deviation of SSIM's Gaussian window, pixels.
const WINDOW_DEVIATION: f64 = 1.5;
/// SSIM's (K1 L)² and (K2 L)² with L = 1.
const STABILISERS: [f64; 2] = [0.01 * 0.01, 0.03 * 0.03];
/// MS-SSIM's exponents from the finest scale down (Wang et al., 2003).
const SCALE_WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

/// One channel of one picture, in [0, 1].
#[derive(Clone)]
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f64>,
}

impl Plane {
    fn combine(&self, other: &Self, with: impl Fn(f64, f64) -> f64) -> Self {
        let values = self.values.iter().zip(&other.values).map(|(&a, &b)| with(a, b)).collect();
        Self { values, ..*self }
    }

    fn mean(&self) -> f64 {
        self.values.iter().sum::<f64>() / self.values.len().max(1) as f64
    }

    /// Convolved by SSIM's window where it fits wholly: 10 pixels smaller each way.
    fn blurred(&self) -> Self {
        let weights: [f64; WINDOW] = std::array::from_fn(|place| {
            let offset = place as f64 - (WINDOW / 2) as f64;
            (-0.5 * (offset / WINDOW_DEVIATION).powi(2)).exp()
        });
        let sum: f64 = weights.iter().sum();
        let (width, height) = (self.width + 1 - WINDOW, self.height + 1 - WINDOW);
        let rows = self.values.windows(WINDOW).enumerate();
        // Windows that run over a row's end are left out.
        let rows = rows.filter(|(start, _)| start % self.width < width);
        let across: Vec<f64> = rows.map(|(_, row)| row.iter().zip(weights).map(|(v, w)| v * w).sum::<f64>()).collect();
        let mut values = vec![0.0; width * height];
        for (y, line) in values.chunks_exact_mut(width).enumerate() {
            for (weight, source) in weights.iter().zip(across.chunks_exact(width).skip(y)) {
                for (value, source) in line.iter_mut().zip(source) {
                    *value += weight * source / (sum * sum);
                }
            }
        }
        Self { width, height, values }
    }

    /// Means of 2 × 2 pixels; a last odd row or column is dropped.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let rows = self.values.chunks_exact(self.width).take(2 * height);
        let pairs: Vec<Vec<f64>> =
            rows.map(|row| row.chunks_exact(2).map(|pair| 0.25 * (pair[0] + pair[1])).collect()).collect();
        let values = pairs.chunks_exact(2).flat_map(|rows| rows[0].iter().zip(&rows[1]).map(|(a, b)| a + b)).collect();
        Self { width, height, values }
    }
}

/// The pictures' channels, in [0, 1].
fn planes(pictures: &Tensor) -> Result<Vec<Vec<Plane>>> {
    let &[count, channels, height, width] = pictures.dims() else {
        return Err(Error::shape("pictures", "[B, C, H, W]", pictures.dims()));
    };
    let values = pictures.detach().to_device(&Device::Cpu)?.to_dtype(DType::F64)?.affine(0.5, 0.5)?;
    let values = values.flatten_all()?.to_vec1::<f64>()?;
    let size = (width * height).max(1);
    let mut planes = values.chunks_exact(size).map(|values| Plane { width, height, values: values.to_vec() });
    Ok((0..count).map(|_| planes.by_ref().take(channels).collect()).collect())
}

fn pairs(a: &Tensor, b: &Tensor) -> Result<Vec<(Vec<Plane>, Vec<Plane>)>> {
    if a.dims() != b.dims() {
        return Err(Error::shape("pictures to compare", a.dims(), b.dims()));
    }
    Ok(planes(a)?.into_iter().zip(planes(b)?).collect())
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1) as f64;
    values.sum::<f64>() / count
}

/// Peak signal-to-noise ratio of each pair, dB, at most [`MAX_PSNR_DB`]: −10 log₁₀ of the mean squared difference.
pub fn psnr(a: &Tensor, b: &Tensor) -> Result<Vec<f64>> {
    let squares = |(a, b): (Vec<Plane>, Vec<Plane>)| {
        mean(a.iter().zip(&b).map(|(a, b)| a.combine(b, |a, b| (a - b).powi(2)).mean()))
    };
    Ok(pairs(a, b)?.into_iter().map(squares).map(decibels).collect())
}

/// PSNR of each pair over the pixels of `weights` `[B, 1, H, W]` (0 to 1), e.g. without the background; none where
/// the weights are all 0.
pub fn psnr_within(a: &Tensor, b: &Tensor, weights: &Tensor) -> Result<Vec<Option<f64>>> {
    let squares = weighted(a, b, weights, |difference| difference * difference)?;
    Ok(squares.into_iter().map(|(inside, _)| inside.map(decibels)).collect())
}

fn decibels(mean_square: f64) -> f64 {
    // NaN stays NaN: `min` would hide it.
    if mean_square.is_nan() { f64::NAN } else { (-10.0 * mean_square.log10()).min(MAX_PSNR_DB) }
}

/// Mean structural similarity and mean contrast-structure term of two channels.
fn similarity(a: &Plane, b: &Plane) -> (f64, f64) {
    let [c1, c2] = STABILISERS;
    let (mean_a, mean_b) = (a.blurred(), b.blurred());
    let square_a = a.combine(a, |x, y| x * y).blurred();
    let square_b = b.combine(b, |x, y| x * y).blurred();
    let product = a.combine(b, |x, y| x * y).blurred();
    let (mut sum, mut contrast_sum) = (0.0, 0.0);
    let means = mean_a.values.iter().zip(&mean_b.values);
    let moments = square_a.values.iter().zip(&square_b.values).zip(&product.values);
    for ((&ma, &mb), ((&aa, &bb), &ab)) in means.zip(moments) {
        let contrast = (2.0 * (ab - ma * mb) + c2) / ((aa - ma * ma) + (bb - mb * mb) + c2);
        contrast_sum += contrast;
        sum += contrast * (2.0 * ma * mb + c1) / (ma * ma + mb * mb + c1);
    }
    let count = mean_a.values.len() as f64;
    (sum / count, contrast_sum / count)
}

/// Structural similarity of each pair (Wang et al., 2004): Gaussian window of 11 pixels where it fits, channels
/// averaged. Pictures must be 11 pixels or more a side.
pub fn ssim(a: &Tensor, b: &Tensor) -> Result<Vec<f64>> {
    scale_count(a)?;
    let one = |(a, b): (Vec<Plane>, Vec<Plane>)| mean(a.iter().zip(&b).map(|(a, b)| similarity(a, b).0));
    Ok(pairs(a, b)?.into_iter().map(one).collect())
}

/// MS-SSIM and how it was computed.
#[derive(Clone, Debug, PartialEq)]
pub struct MultiScale {
    /// One value a pair.
    pub values: Vec<f64>,
    /// Scales used: 5 from 176 pixels on, fewer in smaller pictures. Values of different scales do not compare.
    pub scales: usize,
}

/// Multi-scale structural similarity of each pair (Wang et al., 2003), channels averaged.
///
/// The window must fit at the coarsest scale. Pictures smaller than 176 pixels use as many scales as fit (4 from 88,
/// 3 from 44, 2 from 22, 1 from 11), with the exponents of those normalised to sum to 1.
pub fn ms_ssim(a: &Tensor, b: &Tensor) -> Result<MultiScale> {
    let scales = scale_count(a)?;
    let weights = SCALE_WEIGHTS.get(..scales).unwrap_or(&SCALE_WEIGHTS);
    let sum: f64 = weights.iter().sum();
    let channel = |(mut a, mut b): (Plane, Plane)| {
        let mut product = 1.0;
        for (scale, weight) in weights.iter().enumerate() {
            let (similarity, contrast) = similarity(&a, &b);
            let term = if scale + 1 == scales { similarity } else { contrast };
            // A negative term has no real power.
            product *= if term.is_nan() { term } else { term.max(0.0).powf(weight / sum) };
            if scale + 1 < scales {
                (a, b) = (a.halved(), b.halved());
            }
        }
        product
    };
    let one = |(a, b): (Vec<Plane>, Vec<Plane>)| mean(a.into_iter().zip(b).map(channel));
    Ok(MultiScale { values: pairs(a, b)?.into_iter().map(one).collect(), scales })
}

/// How many of MS-SSIM's scales fit into the pictures.
fn scale_count(pictures: &Tensor) -> Result<usize> {
    let side = match *pictures.dims() {
        [_, _, height, width] => height.min(width),
        _ => 0,
    };
    match (0..SCALE_WEIGHTS.len()).take_while(|scale| side >> scale >= WINDOW).count() {
        0 => Err(Error::shape("pictures to compare", "[B, C, H, W] of at least 11 pixels a side", pictures.dims())),
        scales => Ok(scales),
    }
}

/// Sharpness: the standard deviation of the four-neighbour Laplacian of each picture's luma (Rec. 601), [0, 1] units.
pub fn laplacian_deviation(pictures: &Tensor) -> Result<Vec<f64>> {
    let deviation = |channels: Vec<Plane>| {
        let [red, green, blue] = channels.as_slice() else {
            return Err(Error::shape("pictures", "[B, 3, H, W]", pictures.dims()));
        };
        let luma = red.combine(green, |r, g| 0.299 * r + 0.587 * g).combine(blue, |rg, b| rg + 0.114 * b);
        let at = |x: usize, y: usize| luma.values.get(y * luma.width + x).copied().unwrap_or_default();
        let (columns, rows) = (1..luma.width.saturating_sub(1), 1..luma.height.saturating_sub(1));
        let values: Vec<f64> = rows
            .flat_map(|y| columns.clone().map(move |x| (x, y)))
            .map(|(x, y)| at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1) - 4.0 * at(x, y))
            .collect();
        let centre = mean(values.iter().copied());
        Ok(mean(values.iter().map(|value| (value - centre).powi(2))).sqrt())
    };
    planes(pictures)?.into_iter().map(deviation).collect()
}

/// How much a picture changed where it should, and elsewhere: mean absolute differences in [0, 1] units; none where
/// there is no such pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Weighted by the mask.
    pub inside: Option<f64>,
    /// Weighted by one minus the mask.
    pub outside: Option<f64>,
}

/// The change of each pair inside and outside of `mask` `[B, 1, H, W]`, 0 to 1.
pub fn change(before: &Tensor, after: &Tensor, mask: &Tensor) -> Result<Vec<Change>> {
    let means = weighted(before, after, mask, f64::abs)?;
    Ok(means.into_iter().map(|(inside, outside)| Change { inside, outside }).collect())
}

/// Where either of two mask stacks `[B, 9, H, W]` shows one of `regions`: `[B, 1, H, W]`, 0 to 1. The mask of
/// [`change`] for an edit of these regions.
pub fn either_mask(before: &Tensor, after: &Tensor, regions: RegionSet) -> Result<Tensor> {
    let shown = |masks: &Tensor| -> Result<Tensor> {
        if masks.rank() != 4 || masks.dim(1)? != REGION_COUNT {
            return Err(Error::shape("masks", "[B, 9, H, W]", masks.dims()));
        }
        let rows: Vec<u32> = regions.iter().map(|region| region.index() as u32).collect();
        if rows.is_empty() {
            return Ok(masks.narrow(1, 0, 1)?.zeros_like()?);
        }
        let rows = Tensor::new(rows, masks.device())?;
        Ok(masks.detach().contiguous()?.index_select(&rows, 1)?.sum_keepdim(1)?.clamp(0.0, 1.0)?)
    };
    Ok(shown(before)?.maximum(&shown(after)?)?)
}

/// Means of `measure` of the differences in [0, 1], weighted by `weights` `[B, 1, H, W]` and by one minus them.
fn weighted(
    a: &Tensor,
    b: &Tensor,
    weights: &Tensor,
    measure: impl Fn(f64) -> f64,
) -> Result<Vec<(Option<f64>, Option<f64>)>> {
    let &[count, channels, height, width] = a.dims() else {
        return Err(Error::shape("pictures", "[B, C, H, W]", a.dims()));
    };
    if weights.dims() != [count, 1, height, width] {
        return Err(Error::shape("mask", [count, 1, height, width], weights.dims()));
    }
    // `planes` maps [-1, 1] to [0, 1]; a mask is there already.
    let weights = planes(&weights.to_dtype(DType::F64)?.affine(2.0, -1.0)?)?;
    let one = |((a, b), weights): ((Vec<Plane>, Vec<Plane>), Vec<Plane>)| {
        let mut sums = [0.0; 2];
        let mut totals = [0.0; 2];
        for (a, b) in a.iter().zip(&b) {
            for ((a, b), weight) in a.values.iter().zip(&b.values).zip(weights.iter().flat_map(|plane| &plane.values)) {
                let weight = weight.clamp(0.0, 1.0);
                for (side, weight) in [weight, 1.0 - weight].into_iter().enumerate() {
                    sums[side] += weight * measure(a - b);
                    totals[side] += weight;
                }
            }
        }
        // A few thousandths of a pixel are rounding, not an area.
        let [inside, outside] =
            [0, 1].map(|side| (totals[side] > 1e-3 * channels as f64).then(|| sums[side] / totals[side]));
        (inside, outside)
    };
    Ok(pairs(a, b)?.into_iter().zip(weights).map(one).collect())
}

/// Agreement of label maps, summed over any number of pairs.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Agreement {
    /// Pixels by expected (row) and found (column) region.
    pub confusion: [[u64; REGION_COUNT]; REGION_COUNT],
}

impl Agreement {
    /// Counts the pixels of a pair of maps of one size.
    pub fn add(&mut self, expected: &LabelMap, found: &LabelMap) -> Result<()> {
        if (expected.width(), expected.height()) != (found.width(), found.height()) {
            let dims = [found.height() as usize, found.width() as usize];
            return Err(Error::shape("label map", [expected.height(), expected.width()], &dims));
        }
        for (&expected, &found) in expected.labels().iter().zip(found.labels()) {
            let row = self.confusion.get_mut(usize::from(expected));
            if let Some(count) = row.and_then(|row| row.get_mut(usize::from(found))) {
                *count += 1;
            }
        }
        Ok(())
    }

    /// Intersection over union of a region; none if neither map has it.
    pub fn iou(&self, region: Region) -> Option<f64> {
        let index = region.index();
        let expected: u64 = self.confusion[index].iter().sum();
        let found: u64 = self.confusion.iter().map(|row| row[index]).sum();
        let both = self.confusion[index][index];
        let union = expected + found - both;
        (union > 0).then(|| both as f64 / union as f64)
    }

    /// Mean over the regions that occur; none before any pixel was counted.
    pub fn mean_iou(&self) -> Option<f64> {
        let values: Vec<f64> = Region::ALL.into_iter().filter_map(|region| self.iou(region)).collect();
        (!values.is_empty()).then(|| mean(values.into_iter()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Stream;

    fn constant(value: f64, side: usize) -> Tensor {
        Tensor::full(2.0 * value - 1.0, (1, 3, side, side), &Device::Cpu).unwrap()
    }

    /// A smooth picture and a noisier one, f64.
    fn sample(height: usize, width: usize) -> (Tensor, Tensor) {
        let mut random = Stream::new(5, &[height as u64]);
        let smooth = Tensor::from_vec(
            (0..3 * height * width)
                .map(|at| 0.7 * ((at % width) as f64 * 0.3).sin() * ((at / width) as f64 * 0.2).cos())
                .collect::<Vec<f64>>(),
            (1, 3, height, width),
            &Device::Cpu,
        );
        let smooth = smooth.unwrap();
        let noise = random.uniform_tensor(&[1, 3, height, width], -0.3, 0.3, &Device::Cpu).unwrap();
        let noisy = (&smooth + noise.to_dtype(DType::F64).unwrap()).unwrap();
        (smooth, noisy)
    }

    #[test]
    fn psnr_of_a_known_difference() {
        // 0.1 everywhere: 20 dB. Half the pixels 0.2 off: 10 log10(1 / 0.02).
        let found = psnr(&constant(0.5, 8), &constant(0.6, 8)).unwrap();
        assert!((found[0] - 20.0).abs() < 1e-9);
        let half = Tensor::cat(&[&constant(0.5, 8), &constant(0.7, 8)], 3).unwrap();
        let flat = Tensor::cat(&[&constant(0.5, 8), &constant(0.5, 8)], 3).unwrap();
        assert!((psnr(&half, &flat).unwrap()[0] - 16.989_700_043_360_187).abs() < 1e-9);
        assert_eq!(psnr(&flat, &flat).unwrap(), [MAX_PSNR_DB]);
        assert!(psnr(&flat, &constant(0.5, 8)).is_err());
        let right = Tensor::cat(
            &[
                Tensor::zeros((1, 1, 8, 8), DType::F32, &Device::Cpu).unwrap(),
                Tensor::ones((1, 1, 8, 8), DType::F32, &Device::Cpu).unwrap(),
            ],
            3,
        )
        .unwrap();
        assert!((psnr_within(&half, &flat, &right).unwrap()[0].unwrap() - 13.979_400_086_720_377).abs() < 1e-9);
        assert_eq!(psnr_within(&half, &flat, &right.zeros_like().unwrap()).unwrap(), [None]);
        let mut batch = [constant(0.5, 8), constant(f64::NAN, 8)];
        batch.swap(0, 1);
        assert!(psnr(&batch[0], &batch[1]).unwrap()[0].is_nan());
    }

    #[test]
    fn ssim_of_constants_is_its_luminance_term() {
        let found = ssim(&constant(0.4, 16), &constant(0.6, 16)).unwrap()[0];
        let expected = (2.0 * 0.4 * 0.6 + 1e-4) / (0.16 + 0.36 + 1e-4);
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
    }

    /// SSIM straight from its definition: a two-dimensional window at every place.
    fn ssim_by_definition(a: &Plane, b: &Plane) -> f64 {
        let window = |dx: usize, dy: usize| (-((dx as f64 - 5.0).powi(2) + (dy as f64 - 5.0).powi(2)) / 4.5).exp();
        let places = || (0..121).map(|at| (at % 11, at / 11));
        let total: f64 = places().map(|(dx, dy)| window(dx, dy)).sum();
        let mut sum = 0.0;
        for y in 0..a.height - 10 {
            for x in 0..a.width - 10 {
                let average = |value: &dyn Fn(usize) -> f64| {
                    places().map(|(dx, dy)| window(dx, dy) / total * value((y + dy) * a.width + x + dx)).sum::<f64>()
                };
                let (ma, mb) = (average(&|at| a.values[at]), average(&|at| b.values[at]));
                let va = average(&|at| (a.values[at] - ma).powi(2));
                let vb = average(&|at| (b.values[at] - mb).powi(2));
                let vab = average(&|at| (a.values[at] - ma) * (b.values[at] - mb));
                sum += (2.0 * ma * mb + 1e-4) * (2.0 * vab + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4));
            }
        }
        sum / ((a.width - 10) * (a.height - 10)) as f64
    }

    #[test]
    fn ssim_agrees_with_its_definition() {
        let (a, b) = sample(17, 23);
        let (plane_a, plane_b) = (planes(&a).unwrap().remove(0), planes(&b).unwrap().remove(0));
        let expected = mean(plane_a.iter().zip(&plane_b).map(|(a, b)| ssim_by_definition(a, b)));
        let found = ssim(&a, &b).unwrap()[0];
        assert!((found - expected).abs() < 1e-10 && found < 0.95, "{found} {expected}");
        assert!((ssim(&a, &a).unwrap()[0] - 1.0).abs() < 1e-12);
        assert!(ssim(&constant(0.1, 10), &constant(0.1, 10)).is_err());
    }

    #[test]
    fn ms_ssim_uses_the_scales_that_fit_and_follows_its_formula() {
        for (side, scales) in [(176, 5), (175, 4), (128, 4), (64, 3), (32, 2), (11, 1)] {
            assert_eq!(ms_ssim(&constant(0.3, side), &constant(0.3, side)).unwrap().scales, scales, "{side}");
        }
        // Constants differ in luminance only, which counts at the coarsest scale.
        let found = ms_ssim(&constant(0.4, 176), &constant(0.6, 176)).unwrap().values[0];
        let expected =
            ((2.0 * 0.4 * 0.6 + 1e-4) / (0.16 + 0.36 + 1e-4f64)).powf(0.1333 / SCALE_WEIGHTS.iter().sum::<f64>());
        assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        // Two scales by hand.
        let (a, b) = sample(24, 30);
        let expected = mean(planes(&a).unwrap().remove(0).iter().zip(&planes(&b).unwrap().remove(0)).map(|(a, b)| {
            let sum = 0.0448 + 0.2856;
            similarity(a, b).1.powf(0.0448 / sum) * ssim_by_definition(&a.halved(), &b.halved()).powf(0.2856 / sum)
        }));
        let found = ms_ssim(&a, &b).unwrap();
        assert!((found.values[0] - expected).abs() < 1e-10 && found.scales == 2);
    }

    #[test]
    fn halving_averages_and_drops_odd_edges() {
        let plane = Plane { width: 3, height: 3, values: vec![1.0, 2.0, 9.0, 3.0, 6.0, 9.0, 9.0, 9.0, 9.0] };
        assert_eq!(plane.halved().values, [3.0]);
    }

    #[test]
    fn a_checkerboard_is_as_sharp_as_can_be() {
        let values = (0..64).map(|at| if (at % 8 + at / 8) % 2 == 0 { 1.0 } else { -1.0 });
        let board = Tensor::from_vec(values.collect::<Vec<f64>>(), (1, 1, 8, 8), &Device::Cpu).unwrap();
        let board = Tensor::cat(&[&board, &board, &board], 1).unwrap();
        // Every Laplacian is ±4.
        assert!((laplacian_deviation(&board).unwrap()[0] - 4.0).abs() < 1e-9);
        assert!(laplacian_deviation(&constant(0.7, 8)).unwrap()[0] < 1e-12);
    }

    #[test]
    fn change_is_told_apart_by_the_mask() {
        let before = constant(0.5, 4);
        let after =
            Tensor::cat(&[constant(0.75, 4).narrow(3, 0, 1).unwrap(), before.narrow(3, 1, 3).unwrap()], 3).unwrap();
        let mut values = vec![0f64; 9 * 16];
        for at in 0..16 {
            let region = if at % 4 == 0 { Region::Hair } else { Region::Face };
            values[region.index() * 16 + at] = 1.0;
        }
        let masks = Tensor::from_vec(values, (1, 9, 4, 4), &Device::Cpu).unwrap();
        let mask = either_mask(&masks, &masks, Region::Hair.into()).unwrap();
        assert_eq!(change(&before, &after, &mask).unwrap(), [Change { inside: Some(0.25), outside: Some(0.0) }]);
        let all = either_mask(&masks, &masks, RegionSet::ALL).unwrap();
        assert_eq!(change(&before, &after, &all).unwrap(), [Change { inside: Some(0.0625), outside: None }]);
        let none = either_mask(&masks, &masks, RegionSet::EMPTY).unwrap();
        assert_eq!(change(&before, &after, &none).unwrap()[0].inside, None);
        assert!(change(&before, &after, &masks).is_err());
    }

    #[test]
    fn iou_counts_regions_that_occur() {
        let expected = LabelMap::new(4, 1, vec![0, 0, 1, 1]).unwrap();
        let found = LabelMap::new(4, 1, vec![0, 1, 1, 7]).unwrap();
        let mut agreement = Agreement::default();
        assert_eq!(agreement.mean_iou(), None);
        agreement.add(&expected, &found).unwrap();
        assert_eq!(agreement.iou(Region::Background), Some(0.5));
        assert_eq!(agreement.iou(Region::Face), Some(1.0 / 3.0));
        assert_eq!(agreement.iou(Region::Hair), Some(0.0));
        assert_eq!(agreement.iou(Region::Nose), None);
        assert!((agreement.mean_iou().unwrap() - (0.5 + 1.0 / 3.0) / 3.0).abs() < 1e-12);
        assert!(agreement.add(&expected, &LabelMap::new(2, 2, vec![0; 4]).unwrap()).is_err());
    }
}
