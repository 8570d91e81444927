//! Teaching the network: batches of distorted photos and cartoons, cross-entropy of the regions, and a bounded loss of
//! pose and points where they are known.

use std::path::Path;

use candle_core::{DType, Device, Tensor};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{
    Numbers, SIDE,
    augment::{Example, Shown},
    network::{self, GRID, INPUTS, NUMBERS, Network, Output, PACKED},
    write,
};
use crate::{
    data::{
        cartoon::{RenderOptions, SynthOptions, synth},
        dataset::Dataset,
        labels::LabelMap,
        loader::Order,
        picture::RgbImage,
    },
    error::{Error, Result},
    model::file::{self, Tensors},
    parameters::Parameters,
    region::REGION_COUNT,
    rng::Stream,
    train::optimiser::{Adam, Betas, Group, Schedule},
};

/// What a random draw decides; part of the draw's path.
const DISTORTION: u64 = 0x7061_7273;
/// The drawn cartoons are others than those of `cnerf synth` with the same seed, which may be held out.
const CARTOONS: u64 = 0x7061_7273_6172_7400;
/// Width and height at which cartoons are drawn, pixels.
const CARTOON_SIDE: usize = 160;
const SCHEDULE: Schedule = Schedule { warmup_steps: 60, hold: 0.35, floor: 0.01 };
const BETAS: Betas = Betas { first: 0.9, second: 0.99 };
/// Pixels of small regions count more, in label order: they are few, and edits are aimed at them.
const PIXEL_WEIGHTS: [f32; REGION_COUNT] = [1.0, 1.0, 3.0, 3.0, 2.0, 1.5, 2.0, 1.0, 1.0];
/// Error of a number (radians or half widths) from which its loss grows linearly.
const NUMBER_TOLERANCE: f64 = 0.04;
/// Weight of the numbers' loss beside the regions'.
const NUMBER_WEIGHT: f64 = 0.1;

/// How a parser is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
pub struct ParserTraining {
    /// Optimiser steps
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 2400))]
    pub steps: usize,
    /// Portraits a step
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 16))]
    pub batch: usize,
    /// Adam's largest rate
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 2e-3))]
    pub learning_rate: f64,
    /// Cartoons drawn to learn from beside the photos
    #[cfg_attr(feature = "clap", arg(long, default_value_t = 400))]
    pub cartoons: usize,
    /// Seed of every random draw.
    #[cfg_attr(feature = "clap", arg(skip))]
    pub seed: u64,
}

impl Default for ParserTraining {
    fn default() -> Self {
        Self { steps: 2400, batch: 16, learning_rate: 2e-3, cartoons: 400, seed: 0 }
    }
}

impl ParserTraining {
    /// Refuses numbers that cannot be worked with.
    ///
    /// # Errors
    /// [`Error::Config`] with the option's name.
    pub fn validate(&self) -> Result<()> {
        if !(1..=10_000_000).contains(&self.steps) {
            return Err(Error::config("--steps", format!("{} is outside 1 to 10000000", self.steps)));
        }
        if !(1..=1024).contains(&self.batch) {
            return Err(Error::config("--batch", format!("{} is outside 1 to 1024", self.batch)));
        }
        if !(self.learning_rate > 0.0 && self.learning_rate <= 1.0) {
            return Err(Error::config("--learning-rate", format!("{} is outside 0 to 1", self.learning_rate)));
        }
        if self.cartoons > 100_000 {
            return Err(Error::config("--cartoons", format!("{} is more than 100000", self.cartoons)));
        }
        Ok(())
    }
}

/// What a step found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ParserStep {
    /// Steps done.
    pub step: usize,
    /// Steps in all.
    pub total: usize,
    /// Weighted cross-entropy of the regions, nats a pixel.
    pub cross_entropy: f64,
    /// Share of the pixels whose region was the likeliest.
    pub accuracy: f64,
    /// Mean absolute error of azimuth and elevation, radians.
    pub pose_error_rad: f64,
    /// Mean absolute error of the points, half widths.
    pub point_error: f64,
}

/// A training run: one optimiser step a call.
pub struct ParserTrainer {
    config: ParserTraining,
    examples: Vec<Example>,
    parameters: Parameters,
    network: Network,
    optimiser: Adam,
    order: Order,
    step: usize,
}

impl ParserTrainer {
    /// Decodes every item of `datasets` that has a label map and draws the cartoons. `progress` is called with the
    /// examples there are and those there will be.
    ///
    /// # Errors
    /// If an item cannot be read, an option is out of range, or there is nothing to learn from.
    pub fn new(config: ParserTraining, datasets: &[Dataset], progress: &mut dyn FnMut(usize, usize)) -> Result<Self> {
        config.validate()?;
        let total = datasets.iter().map(Dataset::len).sum::<usize>() + config.cartoons;
        let mut examples = Vec::with_capacity(total);
        for dataset in datasets {
            for start in (0..dataset.len()).step_by(32) {
                let decoded = (start..dataset.len().min(start + 32)).into_par_iter().map(|index| {
                    let item = dataset.item(index)?;
                    item.mask.map(|mask| Example::new(&item.image, &mask, item.camera)).transpose()
                });
                examples.extend(decoded.collect::<Result<Vec<_>>>()?.into_iter().flatten());
                progress(examples.len(), total);
            }
        }
        if config.cartoons > 0 {
            let options = SynthOptions { count: config.cartoons, size: CARTOON_SIDE, ..SynthOptions::default() };
            for item in synth(config.seed ^ CARTOONS, options, RenderOptions::default())? {
                let side = CARTOON_SIDE as u32;
                let absent = || Error::shape("cartoon", [CARTOON_SIDE, CARTOON_SIDE, 3], &[item.picture.rgb.len()]);
                let picture = RgbImage::from_raw(side, side, item.picture.rgb.clone()).ok_or_else(absent)?;
                let labels = LabelMap::new(side, side, item.picture.labels)?;
                examples.push(Example::new(&picture, &labels, Some(item.camera))?);
                progress(examples.len(), total);
            }
        }
        if examples.is_empty() {
            return Err(Error::config("--data", "has no item with a label map, and --cartoons is 0"));
        }
        let parameters = Parameters::fresh(config.seed, DType::F32, &Device::Cpu);
        let network = Network::new(&parameters)?;
        let group = Group {
            variables: parameters.variables(),
            learning_rate: config.learning_rate,
            largest_gradient_norm: Some(1.0),
        };
        let optimiser = Adam::new(vec![group], BETAS);
        let order = Order::new(config.seed, examples.len(), false);
        Ok(Self { config, examples, parameters, network, optimiser, order, step: 0 })
    }

    /// Number of portraits to learn from.
    pub fn examples(&self) -> usize {
        self.examples.len()
    }

    /// Number of weights.
    pub fn parameter_count(&self) -> usize {
        self.parameters.count()
    }

    /// Does one step; `None` when all are done.
    ///
    /// # Errors
    /// If the gradient is not finite.
    pub fn step(&mut self) -> Result<Option<ParserStep>> {
        if self.step >= self.config.steps {
            return Ok(None);
        }
        let (batch, step) = (self.config.batch, self.step as u64);
        let draws = self.order.batch(step, batch);
        let shown = draws.par_iter().enumerate().map(|(place, draw)| {
            let mut random = Stream::new(self.config.seed, &[DISTORTION, step, place as u64]);
            let absent = || Error::shape("examples", [self.examples.len()], &[draw.index]);
            Ok(self.examples.get(draw.index).ok_or_else(absent)?.show(&mut random))
        });
        let shown = shown.collect::<Result<Vec<Shown>>>()?;
        let input = packed(&shown)?;
        let Output { logits, numbers } = self.network.forward(&input)?;
        let regions = RegionLoss::of(&logits.detach().flatten_all()?.to_vec1()?, &shown);
        let outputs = numbers.detach().flatten_all()?.to_vec1()?;
        let known = NumberLoss::of(&outputs, &shown);
        // The gradients are written out below; a sum of products has just these.
        let gradient = |values: Vec<f32>, of: &Tensor| Tensor::from_vec(values, of.dims(), of.device());
        let loss = ((&logits * gradient(regions.gradient, &logits)?)?.sum_all()?
            + (&numbers * gradient(known.gradient, &numbers)?)?.sum_all()?)?;
        self.optimiser.step(&loss.backward()?, SCHEDULE.factor(self.step, self.config.steps))?;
        self.step += 1;
        Ok(Some(ParserStep {
            step: self.step,
            total: self.config.steps,
            cross_entropy: regions.cross_entropy,
            accuracy: regions.accuracy,
            pose_error_rad: known.pose_error,
            point_error: known.point_error,
        }))
    }

    /// Writes all that steps have changed, under a temporary name first.
    pub fn checkpoint(&self, path: &Path) -> Result<()> {
        let mut tensors: Tensors = self.parameters.snapshot()?;
        self.optimiser.save("adam", &mut tensors)?;
        let config = serde_json::to_string(&self.config).map_err(|error| Error::malformed(path, error))?;
        file::write_safetensors(path, &tensors, &[(CHECKPOINT_KEY, config), (STEP_KEY, self.step.to_string())])
    }

    /// Goes on from what [`Self::checkpoint`] wrote: bit by bit as if it had never stopped.
    ///
    /// # Errors
    /// If the file cannot be read or was written with other settings.
    pub fn resume(&mut self, path: &Path) -> Result<()> {
        let (tensors, metadata) = file::parse_safetensors(path, &file::read_bytes(path)?)?;
        let config: ParserTraining = file::header_of(path, &metadata, CHECKPOINT_KEY, "a parser's checkpoint")?;
        if config != self.config {
            let settings = serde_json::to_string(&config).unwrap_or_default();
            return Err(Error::malformed(path, format!("was written with other settings ({settings}); repeat them")));
        }
        self.parameters.restore(&tensors)?;
        self.optimiser.load("adam", &tensors)?;
        self.step = file::header_of(path, &metadata, STEP_KEY, "a parser's checkpoint")?;
        Ok(())
    }

    /// Writes the parser as it stands, for [`super::FaceParser`].
    pub fn write(&self, path: &Path, provenance: &str) -> Result<()> {
        write(path, &self.parameters, provenance)
    }
}

const CHECKPOINT_KEY: &str = "cnerf-parser-training";
const STEP_KEY: &str = "cnerf-parser-step";

/// The pictures as the network reads them, `[B, 12, 64, 64]`.
fn packed(shown: &[Shown]) -> Result<Tensor> {
    let mut values = vec![0f32; shown.len() * INPUTS * GRID * GRID];
    for (values, shown) in values.chunks_exact_mut(INPUTS * GRID * GRID).zip(shown) {
        for (index, &colour) in shown.colours.iter().enumerate() {
            let (channel, pixel) = (index % 3, index / 3);
            values[network::place(channel, pixel % SIDE, pixel / SIDE)] = colour;
        }
    }
    Ok(Tensor::from_vec(values, (shown.len(), INPUTS, GRID, GRID), &Device::Cpu)?)
}

/// Weighted cross-entropy of the regions with its gradient by the logits.
struct RegionLoss {
    gradient: Vec<f32>,
    cross_entropy: f64,
    accuracy: f64,
}

impl RegionLoss {
    fn of(logits: &[f32], shown: &[Shown]) -> Self {
        const LENGTH: usize = REGION_COUNT * PACKED * GRID * GRID;
        let weight = |label: u8| PIXEL_WEIGHTS.get(usize::from(label)).copied().unwrap_or_default();
        let labels = || shown.iter().flat_map(|shown| &shown.labels);
        let total: f64 = labels().map(|label| f64::from(weight(*label))).sum();
        let mut gradient = vec![0f32; logits.len()];
        let found: Vec<(f64, usize)> = gradient
            .par_chunks_exact_mut(LENGTH)
            .zip(logits.par_chunks_exact(LENGTH))
            .zip(shown)
            .map(|((gradient, logits), shown)| {
                let (mut loss, mut right) = (0.0, 0);
                for (pixel, &label) in shown.labels.iter().enumerate() {
                    let place = |region| network::place(region, pixel % SIDE, pixel / SIDE);
                    let shares = network::softmax(|region| logits[place(region)]);
                    let share = shares.get(usize::from(label)).copied().unwrap_or_default();
                    loss -= f64::from(weight(label)) * f64::from(share.max(1e-12)).ln();
                    right += usize::from(shares.iter().all(|other| *other <= share));
                    for (region, other) in shares.into_iter().enumerate() {
                        let expected = if region == usize::from(label) { 1.0 } else { 0.0 };
                        gradient[place(region)] = weight(label) * (other - expected) / total as f32;
                    }
                }
                (loss, right)
            })
            .collect();
        let (loss, right) = found.iter().fold((0.0, 0), |(loss, right), one| (loss + one.0, right + one.1));
        let accuracy = right as f64 / labels().count().max(1) as f64;
        Self { gradient, cross_entropy: loss / total.max(1e-12), accuracy }
    }
}

/// √(1 + (error / tolerance)²) of every known number, with its gradient by the network's outputs.
struct NumberLoss {
    gradient: Vec<f32>,
    pose_error: f64,
    point_error: f64,
}

impl NumberLoss {
    fn of(outputs: &[f32], shown: &[Shown]) -> Self {
        let mut gradient = vec![0f32; outputs.len()];
        // Sums and counts of azimuth and elevation, roll (not told), points.
        let mut errors = [(0.0, 0usize); 3];
        let scale = NUMBER_WEIGHT * Numbers::UNIT / (NUMBER_TOLERANCE * shown.len().max(1) as f64);
        for ((gradient, outputs), shown) in
            gradient.chunks_exact_mut(NUMBERS).zip(outputs.chunks_exact(NUMBERS)).zip(shown)
        {
            for (index, known) in shown.numbers.iter().enumerate() {
                let Some(known) = known else { continue };
                let error = f64::from(outputs[index]) * Numbers::UNIT - known;
                let relative = error / NUMBER_TOLERANCE;
                gradient[index] = (scale * relative / (1.0 + relative * relative).sqrt()) as f32;
                let (sum, count) = &mut errors[if index < 2 {
                    0
                } else if index == 2 {
                    1
                } else {
                    2
                }];
                *sum += error.abs();
                *count += 1;
            }
        }
        let mean = |(sum, count): (f64, usize)| sum / count.max(1) as f64;
        Self { gradient, pose_error: mean(errors[0]), point_error: mean(errors[2]) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn short() -> ParserTraining {
        ParserTraining { steps: 30, batch: 4, cartoons: 3, seed: 5, ..ParserTraining::default() }
    }

    #[test]
    fn it_learns_and_a_resumed_run_goes_on_bit_for_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("checkpoint.safetensors");
        let mut trainer = ParserTrainer::new(short(), &[], &mut |_, _| {}).unwrap();
        let first = trainer.step().unwrap().unwrap();
        for _ in 1..26 {
            trainer.step().unwrap();
        }
        trainer.checkpoint(&path).unwrap();
        let mut resumed = ParserTrainer::new(short(), &[], &mut |_, _| {}).unwrap();
        resumed.resume(&path).unwrap();
        let mut last = Vec::new();
        for trainer in [&mut trainer, &mut resumed] {
            let mut found = None;
            while let Some(step) = trainer.step().unwrap() {
                found = Some(step);
            }
            last.push(found.unwrap());
        }
        assert_eq!(last[0], last[1]);
        assert_eq!(last[0].step, 30);
        assert!(last[0].cross_entropy < 0.75 * first.cross_entropy, "{first:?} {:?}", last[0]);
        let mut other = ParserTrainer::new(ParserTraining { batch: 5, ..short() }, &[], &mut |_, _| {}).unwrap();
        assert!(other.resume(&path).unwrap_err().to_string().contains("other settings"));
    }

    #[test]
    fn the_written_gradients_are_the_losses_own() {
        let mut random = Stream::new(3, &[]);
        let labels: Vec<u8> = (0..SIDE * SIDE).map(|_| random.below(REGION_COUNT) as u8).collect();
        let numbers = std::array::from_fn(|index| (index != 4).then_some(0.1 * index as f64));
        let shown = [Shown { colours: Vec::new(), labels, numbers }];
        let logits: Vec<f32> = (0..REGION_COUNT * SIDE * SIDE).map(|_| random.normal()).collect();
        let outputs: Vec<f32> = (0..NUMBERS).map(|_| random.normal()).collect();
        let found = RegionLoss::of(&logits, &shown);
        // One pixel's logit in 16,384: the change is far above f64's rounding of the sum, softmax's own is f32's.
        for index in [0, 77_777, 140_000] {
            let loss = |step: f32| {
                let mut moved = logits.clone();
                moved[index] += step;
                RegionLoss::of(&moved, &shown).cross_entropy
            };
            let slope = (loss(0.1) - loss(-0.1)) / 0.2;
            assert!((slope - f64::from(found.gradient[index])).abs() < 1e-6, "{slope} {}", found.gradient[index]);
        }
        let known = NumberLoss::of(&outputs, &shown);
        let exact = |index: usize, output: f64| {
            let relative = (output * Numbers::UNIT - 0.1 * index as f64) / NUMBER_TOLERANCE;
            NUMBER_WEIGHT * (1.0 + relative * relative).sqrt()
        };
        for index in [0, 3, 8] {
            let at = f64::from(outputs[index]);
            let slope = (exact(index, at + 1e-5) - exact(index, at - 1e-5)) / 2e-5;
            assert!((slope - f64::from(known.gradient[index])).abs() < 1e-5);
        }
        assert_eq!(known.gradient[4], 0.0);
    }

    #[test]
    fn options_out_of_range_are_named() {
        let config = ParserTraining { batch: 0, ..short() };
        assert!(config.validate().unwrap_err().to_string().starts_with("--batch"));
        let nothing = ParserTraining { cartoons: 0, ..short() };
        let error = ParserTrainer::new(nothing, &[], &mut |_, _| {}).err().unwrap().to_string();
        assert!(error.starts_with("--data"), "{error}");
    }
}
