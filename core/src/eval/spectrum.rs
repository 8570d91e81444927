//! Energy near the Nyquist frequency: dot screens, stripes and checkerboards of upsamplers lie there, and a measure of
//! sharpness alone takes them for detail.

use candle_core::{DType, Device, Tensor};
use rustfft::{Fft, FftPlanner, num_complex::Complex};

use crate::error::{Error, Result};

/// Frequencies counted as near: those of which either component is at least this share of the Nyquist frequency.
pub const NYQUIST_BAND: f64 = 0.875;

/// The share of each picture's luma (Rec. 601) variance that lies near the Nyquist frequency; 0 for a flat picture.
///
/// The mean is removed and a Hann window applied, so that the picture's edges do not count as detail. `pictures`:
/// `[B, 3, H, W]` in [-1, 1].
pub fn nyquist_share(pictures: &Tensor) -> Result<Vec<f64>> {
    let &[_, 3, height, width] = pictures.dims() else {
        return Err(Error::shape("pictures", "[B, 3, H, W]", pictures.dims()));
    };
    let mut planner = FftPlanner::new();
    let (across, down) = (planner.plan_fft_forward(width), planner.plan_fft_forward(height));
    let values = pictures.detach().to_device(&Device::Cpu)?.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()?;
    let size = (width * height).max(1);
    let share = |picture: &[f64]| {
        let channel = |index: usize| picture.iter().skip(index * size).take(size);
        let luma = channel(0).zip(channel(1)).zip(channel(2)).map(|((r, g), b)| 0.299 * r + 0.587 * g + 0.114 * b);
        share_of(luma.collect(), width, height, (across.as_ref(), down.as_ref()))
    };
    Ok(values.chunks_exact(3 * size).map(share).collect())
}

fn share_of(luma: Vec<f64>, width: usize, height: usize, (across, down): (&dyn Fft<f64>, &dyn Fft<f64>)) -> f64 {
    let mean = luma.iter().sum::<f64>() / luma.len().max(1) as f64;
    let window =
        |index: usize, length: usize| (std::f64::consts::PI * (index as f64 + 0.5) / length as f64).sin().powi(2);
    let windowed = luma.iter().enumerate().map(|(index, value)| {
        let weight = window(index % width, width) * window(index / width, height);
        Complex::new((value - mean) * weight, 0.0)
    });
    let mut rows: Vec<Complex<f64>> = windowed.collect();
    across.process(&mut rows);
    let mut columns: Vec<Complex<f64>> =
        (0..width).flat_map(|x| rows.iter().skip(x).step_by(width).copied().collect::<Vec<_>>()).collect();
    down.process(&mut columns);
    // 0 at the constant, 1 at the Nyquist frequency.
    let frequency = |index: usize, length: usize| 2.0 * index.min(length - index) as f64 / length as f64;
    let (mut near, mut total) = (0.0, 0.0);
    for (index, value) in columns.iter().enumerate() {
        let energy = value.norm_sqr();
        total += energy;
        if frequency(index / height, width).max(frequency(index % height, height)) >= NYQUIST_BAND {
            near += energy;
        }
    }
    // An energy of 1e-20 is the rounding of a flat picture.
    if total > 1e-20 { near / total } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(width: usize, height: usize, value: impl Fn(usize, usize) -> f64) -> Tensor {
        let plane: Vec<f64> = (0..width * height).map(|at| value(at % width, at / width)).collect();
        Tensor::from_vec([plane.clone(), plane.clone(), plane].concat(), (1, 3, height, width), &Device::Cpu).unwrap()
    }

    #[test]
    fn a_checkerboard_is_all_nyquist_and_a_slow_wave_none() {
        let board = picture(32, 48, |x, y| if (x + y) % 2 == 0 { 0.5 } else { -0.5 });
        assert!(nyquist_share(&board).unwrap()[0] > 0.99);
        let stripes = picture(32, 48, |x, _| if x % 2 == 0 { 0.5 } else { -0.5 });
        assert!(nyquist_share(&stripes).unwrap()[0] > 0.99);
        let wave = picture(32, 48, |x, y| 0.5 * (0.4 * x as f64).sin() * (0.3 * y as f64).cos());
        assert!(nyquist_share(&wave).unwrap()[0] < 1e-6);
        assert_eq!(nyquist_share(&picture(8, 8, |_, _| 0.3)).unwrap(), [0.0]);
    }

    #[test]
    fn white_noise_has_the_share_of_the_band() {
        let mut random = crate::rng::Stream::new(1, &[]);
        let noise = random.normal_tensor(&[8, 3, 64, 64], &Device::Cpu).unwrap();
        let shares = nyquist_share(&noise).unwrap();
        let mean = shares.iter().sum::<f64>() / shares.len() as f64;
        // Bins below the band: 55 of 64 in each direction.
        let expected = 1.0 - (55.0f64 / 64.0).powi(2);
        assert!((mean - expected).abs() < 0.02, "{mean} {expected}");
    }
}
