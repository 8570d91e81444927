//! Which pixels the next step looks at: those that were off most when they were last seen, and some at random, so that
//! none is forgotten.

use candle_core::{DType, Device, Tensor};
use cnerf_core::rng::Stream;

use crate::error::Result;

/// What a pixel's mean absolute error is taken for before it was seen, colours in [-1, 1]: as large as errors get, so
/// that every pixel is soon seen once.
const UNSEEN: f32 = 0.5;

/// The error of every pixel of a square picture when it was last seen.
#[derive(Clone, Debug)]
pub(crate) struct Focus {
    resolution: usize,
    errors: Vec<f32>,
}

impl Focus {
    /// Of a picture of `resolution` x `resolution` pixels, none of which was seen.
    pub fn new(resolution: usize) -> Self {
        Self { resolution, errors: vec![UNSEEN; resolution * resolution] }
    }

    /// `count` different pixels in random order, u32 indices `[count]`. A share `focus` of a pixel's chance is its share
    /// of all errors, the rest is the same for all.
    pub fn draw(&self, count: usize, focus: f64, random: &mut Stream, device: &Device) -> Result<Tensor> {
        let mean = self.errors.iter().map(|error| f64::from(*error)).sum::<f64>() / self.errors.len().max(1) as f64;
        // Efraimidis and Spirakis (2006): the smallest of exponential draws with these rates are such a sample.
        let mut keys: Vec<(f64, u32)> = (0u32..)
            .zip(&self.errors)
            .map(|(pixel, error)| {
                let rate = focus * f64::from(*error) / mean.max(1e-9) + (1.0 - focus);
                (-f64::from(random.uniform().max(f32::MIN_POSITIVE)).ln() / rate.max(1e-9), pixel)
            })
            .collect();
        let count = count.clamp(1, keys.len().max(1));
        if count < keys.len() {
            keys.select_nth_unstable_by(count, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            keys.truncate(count);
        }
        // Selecting leaves an order of its own; sorted, it is a function of the draws alone.
        keys.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let chosen: Vec<u32> = keys.into_iter().map(|(_, pixel)| pixel).collect();
        let length = chosen.len();
        Ok(Tensor::from_vec(chosen, length, device)?)
    }

    /// Takes note of the colour errors `[1, 3, R]` at `pixels` `[R]`.
    pub fn saw(&mut self, pixels: &Tensor, error: &Tensor) -> Result<()> {
        let errors: Vec<f32> = error.abs()?.mean(1)?.flatten_all()?.to_dtype(DType::F32)?.to_vec1()?;
        for (pixel, error) in pixels.to_vec1::<u32>()?.into_iter().zip(errors) {
            if let Some(place) = self.errors.get_mut(pixel as usize).filter(|_| error.is_finite()) {
                *place = error;
            }
        }
        Ok(())
    }

    /// The errors `[r, r]`, to go on from.
    pub fn state(&self) -> Result<Tensor> {
        Ok(Tensor::from_slice(&self.errors, (self.resolution, self.resolution), &Device::Cpu)?)
    }

    /// Goes on from [`Self::state`].
    pub fn restore(&mut self, state: &Tensor) -> Result<()> {
        self.errors = state.flatten_all()?.to_vec1()?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_that_were_off_are_drawn_more_often_and_none_twice() {
        let mut focus = Focus::new(8);
        let all = Tensor::arange(0u32, 64, &Device::Cpu).unwrap();
        let errors: Vec<f32> = (0..64).map(|pixel| if pixel < 8 { 0.7 } else { 0.02 }).collect();
        focus.saw(&all, &Tensor::from_vec(errors.repeat(3), (1, 3, 64), &Device::Cpu).unwrap()).unwrap();
        let mut counts = [0u32; 64];
        for draw in 0..400 {
            let mut random = Stream::new(draw, &[]);
            let mut pixels: Vec<u32> = focus.draw(16, 0.5, &mut random, &Device::Cpu).unwrap().to_vec1().unwrap();
            pixels.iter().for_each(|pixel| counts[*pixel as usize] += 1);
            pixels.sort_unstable();
            pixels.dedup();
            assert_eq!(pixels.len(), 16);
        }
        let off = counts[..8].iter().sum::<u32>();
        let fine = counts[8..].iter().sum::<u32>();
        assert!(off > 400 * 5 && fine > 400 * 7 && counts.iter().all(|count| *count > 20), "{counts:?}");
        let mut again = Focus::new(8);
        again.restore(&focus.state().unwrap()).unwrap();
        let draw = |focus: &Focus| -> Vec<u32> {
            focus.draw(99, 0.5, &mut Stream::new(1, &[]), &Device::Cpu).unwrap().to_vec1().unwrap()
        };
        assert_eq!(draw(&again), draw(&focus));
        assert_eq!(draw(&focus).len(), 64);
    }
}
