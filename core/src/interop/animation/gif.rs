//! GIF with one palette for the whole sequence and a dither fixed to the screen: neither can flicker.

use gif::{Encoder, Frame, Repeat};
use image::RgbImage;
use rayon::prelude::*;

use crate::error::{Error, Result};

const COLOURS: usize = 256;
const SAMPLES: usize = 1 << 16;
const LLOYD_ROUNDS: usize = 6;

type Colour = [f32; 3];

/// The frames, all of one size, as an endlessly looping GIF.
pub(super) fn encode(frames: &[RgbImage], frames_per_second: f64) -> Result<Vec<u8>> {
    let failed = |error: gif::EncodingError| Error::config("out", format!("cannot be written as GIF: {error}"));
    let Some((width, height)) = frames.first().map(RgbImage::dimensions) else {
        return Err(Error::config("frames", "there is nothing to write"));
    };
    let (Ok(width), Ok(height)) = (u16::try_from(width), u16::try_from(height)) else {
        return Err(Error::config("out", format!("{width} x {height} is too large for a GIF; ask for .apng or .mp4")));
    };
    let palette = Palette::of(frames);
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, width, height, &palette.bytes()).map_err(failed)?;
    encoder.set_repeat(Repeat::Infinite).map_err(failed)?;
    // Delays are whole hundredths of a second: rounding the frames' times, not their delays, keeps the pace.
    let time = |frame: usize| (frame as f64 * 100.0 / frames_per_second).round() as u64;
    for (index, frame) in frames.iter().enumerate() {
        let delay = u16::try_from(time(index + 1) - time(index)).unwrap_or(u16::MAX);
        let frame = Frame { delay, ..Frame::from_indexed_pixels(width, height, palette.dither(frame), None) };
        encoder.write_frame(&frame).map_err(failed)?;
    }
    drop(encoder);
    Ok(bytes)
}

struct Palette {
    /// In the order of [`sort`], which [`nearest`] relies on.
    colours: Vec<Colour>,
    /// Strength of the dither, in colour levels: how far neighbouring palette colours lie apart where pixels are.
    spread: f32,
}

impl Palette {
    /// A palette for the pixels of all frames: NeuQuant's, refined by Lloyd's algorithm.
    fn of(frames: &[RgbImage]) -> Self {
        let pixels: usize = frames.iter().map(|frame| frame.len() / 3).sum();
        // A prime-like step does not fall into step with rows or frames.
        let step = (pixels / SAMPLES).max(1) | 1;
        let all = frames.iter().flat_map(|frame| frame.as_chunks::<3>().0);
        let samples: Vec<[u8; 3]> = all.step_by(step).copied().collect();
        let distinct: std::collections::BTreeSet<[u8; 3]> = samples.iter().copied().take(SAMPLES).collect();
        if step == 1 && distinct.len() <= COLOURS && samples.len() <= SAMPLES {
            let mut colours: Vec<Colour> = distinct.into_iter().map(|colour| colour.map(f32::from)).collect();
            sort(&mut colours);
            return Self { colours, spread: 0.0 };
        }
        let opaque: Vec<u8> = samples.iter().flat_map(|[r, g, b]| [*r, *g, *b, 255]).collect();
        let start = color_quant::NeuQuant::new(3, COLOURS, &opaque).color_map_rgb();
        let mut colours: Vec<Colour> = start.as_chunks::<3>().0.iter().map(|colour| colour.map(f32::from)).collect();
        let samples: Vec<Colour> = samples.into_iter().map(|colour| colour.map(f32::from)).collect();
        sort(&mut colours);
        for _ in 0..LLOYD_ROUNDS {
            let nearest: Vec<usize> = samples.par_iter().map(|sample| nearest(&colours, *sample)).collect();
            let mut sums = vec![([0f64; 3], 0u32); colours.len()];
            for (sample, &index) in samples.iter().zip(&nearest) {
                let (sum, count) = &mut sums[index];
                *sum = std::array::from_fn(|channel| sum[channel] + f64::from(sample[channel]));
                *count += 1;
            }
            for (colour, (sum, count)) in colours.iter_mut().zip(sums) {
                if count > 0 {
                    *colour = sum.map(|channel| (channel / f64::from(count)) as f32);
                }
            }
            sort(&mut colours);
        }
        colours.iter_mut().for_each(|colour| *colour = colour.map(f32::round));
        sort(&mut colours);
        let misses = samples.par_iter().map(|sample| f64::from(distance(colours[nearest(&colours, *sample)], *sample)));
        // Sum in order: the same bytes at any thread count.
        let misses: Vec<f64> = misses.collect();
        let mean = misses.iter().sum::<f64>() / misses.len().max(1) as f64;
        // A uniform error of a step s has the variance s^2 / 12 in each channel.
        Self { colours, spread: (mean / 3.0 * 12.0).sqrt().min(24.0) as f32 }
    }

    fn bytes(&self) -> Vec<u8> {
        self.colours.iter().flat_map(|colour| colour.map(|channel| channel.clamp(0.0, 255.0) as u8)).collect()
    }

    /// Palette indices of a frame. What is added before rounding to the palette depends on the place alone
    /// (interleaved gradient noise, Jimenez 2014), so that still parts of a sequence stay still.
    fn dither(&self, frame: &RgbImage) -> Vec<u8> {
        let width = frame.width().max(1) as usize;
        let pixels = frame.as_chunks::<3>().0;
        let index_of = |(place, pixel): (usize, &[u8; 3])| {
            let (x, y) = ((place % width) as f64, (place / width) as f64);
            let noise = (52.982_918_9 * (0.067_110_56 * x + 0.005_837_15 * y).fract()).fract() as f32 - 0.5;
            nearest(&self.colours, pixel.map(|channel| f32::from(channel) + noise * self.spread)) as u8
        };
        pixels.par_iter().enumerate().map(index_of).collect()
    }
}

fn distance(a: Colour, b: Colour) -> f32 {
    let [r, g, b] = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    r * r + g * g + b * b
}

/// By green, in which pictures differ most.
fn sort(colours: &mut [Colour]) {
    colours.sort_by(|a, b| a[1].total_cmp(&b[1]));
}

/// The index of the palette's nearest colour. Looks outwards from the colour's green and stops where green alone is
/// farther than the best: about three times as fast as looking at all colours.
fn nearest(palette: &[Colour], colour: Colour) -> usize {
    let start = palette.partition_point(|candidate| candidate[1] < colour[1]);
    let mut best = (f32::INFINITY, 0);
    let mut consider = |index: usize| {
        let Some(candidate) = palette.get(index) else { return false };
        let distance = distance(*candidate, colour);
        if distance < best.0 {
            best = (distance, index);
        }
        (candidate[1] - colour[1]).powi(2) < best.0
    };
    // Up and down in turn: the best gets small soon, and both directions stop early.
    let (mut above, mut below) = (Some(start), start.checked_sub(1));
    while above.is_some() || below.is_some() {
        above = above.filter(|index| consider(*index)).map(|index| index + 1);
        below = below.filter(|index| consider(*index)).and_then(|index| index.checked_sub(1));
    }
    best.1
}
