//! Adaptive discriminator augmentation (Karras et al. 2020, "Training Generative Adversarial Networks with Limited
//! Data", ADA): a discriminator that has few photos soon knows them by heart. It is shown every picture, real or not,
//! moved, turned, scaled and recoloured at random, the more the surer it is of the real ones.
//!
//! A picture and its masks are moved alike; colours change in the picture only. There is no mirroring: a mirrored
//! picture shows another camera, and the view discriminator would learn wrong angles. Where a moved picture has no
//! content it is continued by reflection, as in ADA. Every change is linear in the picture, and the generator's
//! gradients pass through it. R1's gradient is taken with respect to what the discriminator sees, the changed picture;
//! StyleGAN2-ADA goes on through the change to the picture before it.

use candle_core::{Device, Tensor};

use crate::{
    error::{Error, Result},
    model::file::Tensors,
    rng::Stream,
    train::{adversarial::Pictures, events::Metrics, team::Team},
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x6175_676d;
/// Steps whose verdicts are averaged before p moves (ADA).
const INTERVAL_STEPS: usize = 4;
/// Up to about here, generated pictures do not show the augmentations themselves (ADA, §2.2: the safe limit).
const LARGEST_PROBABILITY: f64 = 0.8;
/// Pictures are moved by up to this share of their side, in whole pixels (ADA).
const LARGEST_SHIFT: f64 = 0.125;
/// Standard deviation of log₂ of the scale (ADA).
const SCALE_DEVIATION: f64 = 0.2;
/// Standard deviation of what is added to colours in [-1, 1] (ADA).
const BRIGHTNESS_DEVIATION: f64 = 0.2;
/// Standard deviation of log₂ of the contrast (ADA).
const CONTRAST_DEVIATION: f64 = 0.5;
/// Standard deviation of log₂ of the saturation (ADA).
const SATURATION_DEVIATION: f64 = 1.0;
/// Name of the state in checkpoints.
const STATE: &str = "augmentation";

/// What a batch is made for: each has draws of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    /// Real pictures.
    Real,
    /// Generated pictures; where the discriminator's and the generator's step share them, for both.
    Fake,
    /// Generated pictures of a generator's step of its own.
    Generator,
}

/// The augmentation of one discriminator, and how often it happens.
#[derive(Debug)]
pub struct Augmenter {
    target: f64,
    ramp_images: usize,
    seed: u64,
    team: Team,
    probability: f64,
    /// Sum of the verdicts' mean signs since p moved, and their number.
    gathered: (f64, usize),
}

/// How one picture is changed.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Change {
    /// Whole pixels that the content moves right and down.
    shift: [f64; 2],
    scale: f64,
    angle_rad: f64,
    /// Added to the colours, before contrast.
    brightness: f64,
    contrast: f64,
    saturation: f64,
}

const NO_CHANGE: Change =
    Change { shift: [0.0; 2], scale: 1.0, angle_rad: 0.0, brightness: 0.0, contrast: 1.0, saturation: 1.0 };

impl Augmenter {
    /// p is 0 and moves so that the mean sign of the verdicts on real pictures comes near `target` (ADA: 0.6); it takes
    /// `ramp_images` real pictures from 0 to 1 (ADA: 500,000). A target of 0 changes no picture, ever.
    pub fn new(target: f64, ramp_images: usize, seed: u64, team: &Team) -> Self {
        Self { target, ramp_images, seed, team: team.clone(), probability: 0.0, gathered: (0.0, 0) }
    }

    fn is_off(&self) -> bool {
        self.target <= 0.0
    }

    /// The same, with another p.
    #[cfg(test)]
    pub(super) fn with_probability(self, probability: f64) -> Self {
        Self { probability, ..self }
    }

    /// The pictures `[B, 3, r, r]` and masks `[B, C, r, r]` that a discriminator is shown in place of `pictures` at
    /// `step`. Each of the six changes happens to each picture with probability p.
    pub fn apply(&self, step: usize, purpose: Purpose, pictures: Pictures<'_>) -> Result<(Tensor, Tensor)> {
        let Pictures { image, masks } = pictures;
        if self.is_off() || self.probability <= 0.0 {
            return Ok((image.clone(), masks.clone()));
        }
        let (batch, _, height, width) = image.dims4()?;
        if height != width || masks.dims4().map(|(b, _, h, w)| (b, h, w))? != (batch, height, width) {
            return Err(Error::shape("masks", format!("[{batch}, C, {height}, {height}]"), masks.dims()));
        }
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, purpose as u64]);
        let share = self.team.share();
        let whole: Vec<Change> = (0..share.whole(batch)).map(|_| self.draw(width, &mut random)).collect();
        let changes = share.pick(&whole);
        let (mut image, mut masks) = (image.clone(), masks.clone());
        let moves = |change: &Change| change.moves();
        if changes.iter().any(moves) {
            let sampler = Sampler::new(&changes, width, image.device())?;
            (image, masks) = (sampler.sample(&image)?, sampler.sample(&masks)?);
        }
        Ok((recoloured(&image, &changes)?, masks))
    }

    fn draw(&self, side: usize, random: &mut Stream) -> Change {
        let happens = |random: &mut Stream| f64::from(random.uniform()) < self.probability;
        let mut change = NO_CHANGE;
        if happens(random) {
            let mut shift = || {
                let share = f64::from(random.range(-1.0, 1.0)) * LARGEST_SHIFT;
                (share * side as f64).round()
            };
            change.shift = [shift(), shift()];
        }
        if happens(random) {
            change.scale = (SCALE_DEVIATION * f64::from(random.normal())).exp2();
        }
        if happens(random) {
            change.angle_rad = f64::from(random.range(-1.0, 1.0)) * std::f64::consts::PI;
        }
        if happens(random) {
            change.brightness = BRIGHTNESS_DEVIATION * f64::from(random.normal());
        }
        if happens(random) {
            change.contrast = (CONTRAST_DEVIATION * f64::from(random.normal())).exp2();
        }
        if happens(random) {
            change.saturation = (SATURATION_DEVIATION * f64::from(random.normal())).exp2();
        }
        change
    }

    /// Takes note of the verdicts `[B, 1]` on a step's real pictures. Every few steps p moves: up while the
    /// discriminator is surer of them than the target, else down.
    pub fn adapt(&mut self, verdicts: &Tensor, metrics: &mut Metrics) -> Result<()> {
        if self.is_off() {
            return Ok(());
        }
        let sign = verdicts.detach().sign()?.mean_all()?.to_dtype(candle_core::DType::F32)?;
        let sign = f64::from(self.team.mean(&sign)?.to_scalar::<f32>()?);
        self.gathered = (self.gathered.0 + sign, self.gathered.1 + 1);
        if self.gathered.1 >= INTERVAL_STEPS {
            let mean = self.gathered.0 / self.gathered.1 as f64;
            let images = self.team.share().whole(verdicts.dim(0)?) * self.gathered.1;
            let moved = images as f64 / self.ramp_images.max(1) as f64;
            let moved = if mean > self.target { moved } else { -moved };
            self.probability = (self.probability + moved).clamp(0.0, LARGEST_PROBABILITY);
            self.gathered = (0.0, 0);
        }
        metrics.push("real_sign", sign);
        metrics.push("augment_probability", self.probability);
        Ok(())
    }

    /// Adds p, and the verdicts since it moved, to a checkpoint.
    pub fn save(&self, tensors: &mut Tensors) -> Result<()> {
        if !self.is_off() {
            let state = [self.probability, self.gathered.0, self.gathered.1 as f64];
            tensors.insert(STATE.to_owned(), Tensor::new(&state, &Device::Cpu)?);
        }
        Ok(())
    }

    /// Reads what [`Self::save`] added; p starts at 0 where a run had no augmentation before.
    pub fn load(&mut self, tensors: &Tensors) -> Result<()> {
        if let Some(state) = tensors.get(STATE).filter(|_| !self.is_off()) {
            let [probability, sum, count] = state.to_vec1::<f64>()?[..] else {
                return Err(Error::shape(STATE, [3], state.dims()));
            };
            (self.probability, self.gathered) = (probability, (sum, count as usize));
        }
        Ok(())
    }
}

impl Change {
    fn moves(&self) -> bool {
        (self.shift, self.scale, self.angle_rad) != (NO_CHANGE.shift, NO_CHANGE.scale, NO_CHANGE.angle_rad)
    }

    fn recolours(&self) -> bool {
        (self.brightness, self.contrast, self.saturation)
            != (NO_CHANGE.brightness, NO_CHANGE.contrast, NO_CHANGE.saturation)
    }

    /// Where the pixel (x, y) of the changed picture comes from, pixels; centres are whole numbers.
    fn source(&self, [x, y]: [f64; 2], side: usize) -> [f64; 2] {
        if !self.moves() {
            return [x, y];
        }
        let middle = (side as f64 - 1.0) / 2.0;
        let (x, y) = (x - self.shift[0] - middle, y - self.shift[1] - middle);
        if (self.scale, self.angle_rad) == (NO_CHANGE.scale, NO_CHANGE.angle_rad) {
            return [x + middle, y + middle];
        }
        let (sin, cos) = self.angle_rad.sin_cos();
        [(cos * x + sin * y) / self.scale + middle, (cos * y - sin * x) / self.scale + middle]
    }

    /// Rows of the matrix that colours are multiplied by. Saturation stretches what is left after their grey part, the
    /// projection on (1, 1, 1), is taken away.
    fn colour_matrix(&self) -> [[f64; 3]; 3] {
        let grey = (1.0 - self.saturation) / 3.0;
        let entry =
            |row: usize, column: usize| self.contrast * (grey + if row == column { self.saturation } else { 0.0 });
        std::array::from_fn(|row| std::array::from_fn(|column| entry(row, column)))
    }
}

/// Bilinear sampling of B pictures, each by a change of its own: four weighted gathers.
struct Sampler {
    side: usize,
    /// Places among a picture's pixels, `[B, 1, r²]`, u32, and their weights.
    corners: Vec<(Tensor, Tensor)>,
}

impl Sampler {
    fn new(changes: &[Change], side: usize, device: &Device) -> Result<Self> {
        let count = changes.len() * side * side;
        let mut places: [Vec<u32>; 4] = std::array::from_fn(|_| Vec::with_capacity(count));
        let mut weights: [Vec<f64>; 4] = std::array::from_fn(|_| Vec::with_capacity(count));
        for change in changes {
            for pixel in 0..side * side {
                let from = change.source([(pixel % side) as f64, (pixel / side) as f64], side);
                let [(x, right), (y, down)] = from.map(|place| {
                    let place = reflected(place, side);
                    (place as usize, place.fract())
                });
                let (next_x, next_y) = ((x + 1).min(side - 1), (y + 1).min(side - 1));
                let corners = [
                    (x, y, (1.0 - right) * (1.0 - down)),
                    (next_x, y, right * (1.0 - down)),
                    (x, next_y, (1.0 - right) * down),
                    (next_x, next_y, right * down),
                ];
                for ((x, y, weight), (places, weights)) in corners.into_iter().zip(places.iter_mut().zip(&mut weights))
                {
                    places.push((y * side + x) as u32);
                    weights.push(weight);
                }
            }
        }
        let shape = (changes.len(), 1, side * side);
        let corners = places.into_iter().zip(weights).map(|(places, weights)| {
            Ok((Tensor::from_vec(places, shape, device)?, Tensor::from_vec(weights, shape, device)?))
        });
        Ok(Self { side, corners: corners.collect::<Result<_>>()? })
    }

    /// `[B, C, r, r]` to the same.
    fn sample(&self, pictures: &Tensor) -> Result<Tensor> {
        let (batch, channels, ..) = pictures.dims4()?;
        let flat = pictures.reshape((batch, channels, self.side * self.side))?;
        let parts = self.corners.iter().map(|(places, weights)| -> Result<Tensor> {
            let places = places.broadcast_as(flat.shape())?.contiguous()?;
            Ok(flat.gather(&places, 2)?.broadcast_mul(&weights.to_dtype(flat.dtype())?)?)
        });
        let sum = parts.reduce(|sum, part| Ok((sum? + part?)?));
        let sum = sum.ok_or_else(|| Error::shape("corners", "four", &[0]))??;
        Ok(sum.reshape(pictures.shape())?)
    }
}

/// A place on the line of `side` pixels, mirrored at the outer pixels' centres until it lies between them.
fn reflected(place: f64, side: usize) -> f64 {
    let last = (side - 1) as f64;
    if last == 0.0 {
        return 0.0;
    }
    let place = place.rem_euclid(2.0 * last);
    place.min(2.0 * last - place)
}

/// Pictures `[B, 3, r, r]` with their colours changed.
fn recoloured(image: &Tensor, changes: &[Change]) -> Result<Tensor> {
    if !changes.iter().any(Change::recolours) {
        return Ok(image.clone());
    }
    let (batch, _, height, width) = image.dims4()?;
    let here = |values: Vec<f64>, columns: usize| -> Result<Tensor> {
        Ok(Tensor::from_vec(values, (batch, 3, columns), image.device())?.to_dtype(image.dtype())?)
    };
    let matrices: Vec<f64> = changes.iter().flat_map(Change::colour_matrix).flatten().collect();
    let added: Vec<f64> = changes.iter().flat_map(|change| [change.contrast * change.brightness; 3]).collect();
    let flat = image.reshape((batch, 3, height * width))?;
    let colours = here(matrices, 3)?.matmul(&flat)?.broadcast_add(&here(added, 1)?)?;
    Ok(colours.reshape(image.shape())?)
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Var};

    use super::*;

    const SIDE: usize = 6;

    fn augmenter(probability: f64) -> Augmenter {
        Augmenter::new(0.6, 100, 3, &Team::default()).with_probability(probability)
    }

    fn random(seed: u64, channels: usize) -> Tensor {
        let shape = [4, channels, SIDE, SIDE];
        Stream::new(seed, &[]).normal_tensor(&shape, &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap()
    }

    fn numbers(tensor: &Tensor) -> Vec<f64> {
        tensor.to_dtype(DType::F64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    fn sampled(change: Change, picture: &Tensor) -> Vec<f64> {
        let changes = vec![change; picture.dim(0).unwrap()];
        numbers(&Sampler::new(&changes, SIDE, &Device::Cpu).unwrap().sample(picture).unwrap())
    }

    #[test]
    fn shifts_and_quarter_turns_move_pixels_and_reflect_at_the_edge() {
        let picture = random(1, 2);
        let before = numbers(&picture);
        let at = |plane: usize, x: usize, y: usize| before[(plane * SIDE + y) * SIDE + x];
        assert_eq!(sampled(NO_CHANGE, &picture), before);
        let shifted = sampled(Change { shift: [2.0, -1.0], ..NO_CHANGE }, &picture);
        let turned = sampled(Change { angle_rad: std::f64::consts::FRAC_PI_2, ..NO_CHANGE }, &picture);
        for plane in 0..8 {
            for (x, y) in (0..SIDE * SIDE).map(|pixel| (pixel % SIDE, pixel / SIDE)) {
                let from = (x.abs_diff(2), if y == SIDE - 1 { SIDE - 2 } else { y + 1 });
                assert_eq!(shifted[(plane * SIDE + y) * SIDE + x], at(plane, from.0, from.1), "{x} {y}");
                let turned = turned[(plane * SIDE + y) * SIDE + x];
                assert!((turned - at(plane, y, SIDE - 1 - x)).abs() < 1e-9, "{x} {y}");
            }
        }
    }

    #[test]
    fn pictures_and_masks_move_alike_and_masks_keep_their_colours() {
        let image = random(1, 3);
        let (moved, masks) = augmenter(0.8).apply(5, Purpose::Real, Pictures { image: &image, masks: &image }).unwrap();
        assert!(numbers(&moved) != numbers(&masks), "colours did not change");
        assert!(numbers(&masks) != numbers(&image), "nothing moved");
        let mut random = Stream::new(3, &[STREAM, 5, 0]);
        let changes: Vec<Change> = (0..4).map(|_| augmenter(0.8).draw(SIDE, &mut random)).collect();
        assert_eq!(numbers(&recoloured(&masks, &changes).unwrap()), numbers(&moved));
        // Shares of a pixel still sum to 1.
        let ones = image.ones_like().unwrap();
        let (_, masks) = augmenter(0.8).apply(5, Purpose::Real, Pictures { image: &image, masks: &ones }).unwrap();
        assert!(numbers(&masks).iter().all(|sum| (sum - 1.0).abs() < 1e-12));
        let (same, _) = augmenter(0.0).apply(5, Purpose::Real, Pictures { image: &image, masks: &ones }).unwrap();
        assert_eq!(numbers(&same), numbers(&image));
    }

    #[test]
    fn grey_stays_grey_and_saturation_zero_leaves_the_mean() {
        let matrix = Change { saturation: 0.0, contrast: 2.0, ..NO_CHANGE }.colour_matrix();
        let brightest = |colour: [f64; 3]| matrix.map(|row| row.iter().zip(colour).map(|(a, b)| a * b).sum::<f64>());
        for value in brightest([0.3, 0.6, 0.0]) {
            assert!((value - 0.6).abs() < 1e-12);
        }
        let matrix = Change { saturation: 3.0, ..NO_CHANGE }.colour_matrix();
        assert!(matrix.iter().all(|row| (row.iter().sum::<f64>() - 1.0).abs() < 1e-12));
    }

    #[test]
    fn gradients_match_finite_differences() {
        let (image, masks) = (random(1, 3), random(2, 2));
        let value = |image: &Tensor, masks: &Tensor| {
            let (image, masks) = augmenter(0.8).apply(1, Purpose::Generator, Pictures { image, masks }).unwrap();
            let (image, masks) = (image.sin().unwrap().sum_all().unwrap(), masks.sqr().unwrap().sum_all().unwrap());
            (image + masks).unwrap()
        };
        let variables = [Var::from_tensor(&image).unwrap(), Var::from_tensor(&masks).unwrap()];
        let gradients = value(&variables[0], &variables[1]).backward().unwrap();
        for (index, input) in [&image, &masks].into_iter().enumerate() {
            let gradient = numbers(gradients.get(&variables[index]).unwrap());
            for place in 0..input.elem_count() {
                let moved = |step: f64| {
                    let mut values = numbers(input);
                    values[place] += step;
                    let moved = Tensor::from_vec(values, input.shape(), &Device::Cpu).unwrap();
                    let sum = if index == 0 { value(&moved, &masks) } else { value(&image, &moved) };
                    sum.to_scalar::<f64>().unwrap()
                };
                let expected = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                let error = (gradient[place] - expected).abs();
                assert!(error < 1e-7 + 1e-6 * expected.abs(), "{index}[{place}]: {} {expected}", gradient[place]);
            }
        }
    }

    #[test]
    fn p_follows_the_verdicts_within_its_bounds_and_survives_a_stop() {
        let verdicts = |signs: [f32; 4]| Tensor::new(&signs, &Device::Cpu).unwrap().reshape((4, 1)).unwrap();
        let mut augmenter = augmenter(0.0);
        let mut metrics = Metrics::default();
        let sure = verdicts([1.0, 2.0, 0.1, 3.0]);
        for _ in 0..INTERVAL_STEPS {
            assert_eq!(augmenter.probability, 0.0);
            augmenter.adapt(&sure, &mut metrics).unwrap();
        }
        // 16 pictures of the 100 that take p from 0 to 1.
        assert!((augmenter.probability - 0.16).abs() < 1e-12, "{augmenter:?}");
        (0..40).for_each(|_| augmenter.adapt(&sure, &mut metrics).unwrap());
        assert_eq!(augmenter.probability, LARGEST_PROBABILITY);
        assert_eq!(metrics.get("real_sign"), Some(1.0));
        // A mean sign of 0.5 is below the target.
        let unsure = verdicts([1.0, -1.0, 1.0, 1.0]);
        (0..5).for_each(|_| augmenter.adapt(&unsure, &mut metrics).unwrap());
        assert!((augmenter.probability - (LARGEST_PROBABILITY - 0.16)).abs() < 1e-12, "{augmenter:?}");
        let mut saved = Tensors::new();
        augmenter.save(&mut saved).unwrap();
        let mut resumed = Augmenter::new(0.6, 100, 3, &Team::default());
        resumed.load(&saved).unwrap();
        assert_eq!((resumed.probability, resumed.gathered), (augmenter.probability, augmenter.gathered));
        (0..40).for_each(|_| resumed.adapt(&unsure, &mut metrics).unwrap());
        assert_eq!(resumed.probability, 0.0);
        let mut off = Augmenter::new(0.0, 100, 3, &Team::default());
        (0..8).for_each(|_| off.adapt(&sure, &mut metrics).unwrap());
        assert_eq!(off.probability, 0.0);
    }
}
