//! Stage `upsampler`: the field frozen, the 2D generator learns to lift its renders.
//!
//! Two teachers, mixed by their weights: the portrait a training code belongs to (shared/recipe: every warmed-up
//! portrait's soft render is paired with its sharp photo; L1 and LPIPS on crops), and the high-resolution
//! discriminator on random portraits (the paper's second stage).

use std::sync::Arc;

use candle_core::{DType, Device, Tensor};
use image::RgbImage;

use crate::{
    camera::Camera,
    codes,
    data::{
        dataset::Dataset,
        loader::{Cached, Draw, Loader, LoaderConfig},
    },
    error::{Error, Result},
    eval::perceptual::Perceptual,
    model::{
        discriminator::{Discriminator, DiscriminatorConfig, DiscriminatorKind},
        file::Tensors,
        generator::Generator,
        upsampler::{Noise, Upsampler, UpsamplerOutput},
    },
    parameters::Parameters,
    render::{Frame, RenderSettings, TwoPass},
    rng::Stream,
    train::{
        adversarial::{Auxiliary, PathLength, Pictures, R1Weights, discriminator_loss, generator_terms},
        average::Average,
        config::{TrainConfig, UpsamplerStageConfig},
        events::Metrics,
        losses,
        optimiser::{Adam, Betas, Group},
        portrait_codes::PortraitCodes,
        preview,
        trainer::{Inputs, StageRun, Start},
    },
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x7570_7361;
/// Renders of training portraits are kept up to this many; beyond it they are rendered each time they are needed.
const MOST_KEPT: usize = 2_500;
/// LPIPS sees each crop shifted by up to this, pixels: AlexNet's stride of 4 with crops on even offsets draws stripes.
const LARGEST_SHIFT: usize = 3;
/// Path lengths are measured on a batch smaller by this (authors).
const PATH_BATCH_SHRINK: usize = 2;
/// Share of a new batch in the running mean of path lengths (authors).
const PATH_DECAY: f64 = 0.01;
/// Name of that mean in checkpoints.
const PATH_MEAN: &str = "path_length_mean";

/// The running stage.
pub struct UpsamplerStage {
    config: UpsamplerStageConfig,
    seed: u64,
    device: Device,
    generator: Generator,
    average: Average,
    perceptual: Option<Perceptual>,
    optimiser: Adam,
    /// Running mean of path lengths, a scalar.
    path_mean: Tensor,
    paired: Option<Paired>,
    adversary: Option<Adversary>,
}

/// Training portraits with codes, and their renders.
struct Paired {
    portraits: Cached,
    draws: Vec<Draw>,
    codes: PortraitCodes,
    renders: Vec<Option<Render>>,
    kept: usize,
}

/// A render as the upsampler reads it, f16: half the memory, and an error far below the renders' own.
#[derive(Clone)]
struct Render {
    values: Tensor,
    has_normal: bool,
}

struct Adversary {
    discriminator: Discriminator,
    parameters: Parameters,
    optimiser: Adam,
    loader: Loader,
    next_batch: usize,
    source: (Arc<Dataset>, LoaderConfig),
}

impl UpsamplerStage {
    /// A fresh upsampler on the field of `start`, or the one it has if that is of the configured form.
    pub fn new(config: &TrainConfig, inputs: &Inputs, start: Option<&Start>) -> Result<Self> {
        let stage = config.upsampler.clone();
        let start = start.ok_or_else(|| {
            Error::config(
                "--stage upsampler",
                "needs a trained field; pass --model RUN/model.safetensors or --stage all",
            )
        })?;
        let wanted = config.model.upsampler.as_ref();
        let wanted =
            wanted.ok_or_else(|| Error::config("model.upsampler", "this configuration has no upsampler to train"))?;
        let generator = if start.generator.config().upsampler.as_ref() == Some(wanted) {
            start.generator.duplicate()?
        } else {
            start.generator.with_upsampler(Some(wanted), config.seed)?
        };
        let resolution = wanted.output_resolution;
        let betas = Betas { first: stage.betas[0], second: stage.betas[1] };
        let group = |variables, learning_rate| Group { variables, learning_rate, largest_gradient_norm: None };
        let variables = generator.parameters().within("upsampler").variables();
        let optimiser = Adam::new(vec![group(variables, stage.learning_rate)], betas);

        let paired = (stage.pixels > 0.0 || stage.perceptual > 0.0)
            .then(|| Paired::new(config, inputs, start.portrait_codes.as_ref(), resolution))
            .transpose()?;
        if stage.perceptual > 0.0 && inputs.perceptual.is_none() {
            let reason = "needs LPIPS weights; pass --lpips FILE, or --set upsampler.perceptual=0";
            return Err(Error::config("upsampler.perceptual", reason));
        }
        let adversary = (stage.adversarial > 0.0)
            .then(|| {
                let parameters = Parameters::fresh(config.seed, DType::F32, &inputs.device);
                let discriminator = DiscriminatorConfig {
                    kind: DiscriminatorKind::HighResolution,
                    resolution,
                    channel_multiplier: stage.channel_multiplier,
                };
                let discriminator = Discriminator::new(&discriminator, &parameters.within("discriminator"))?;
                let loader = LoaderConfig {
                    resolutions: vec![resolution],
                    batch: stage.batch,
                    mirror: config.mirror,
                    seed: config.seed,
                    ..LoaderConfig::default()
                };
                Ok::<_, Error>(Adversary {
                    optimiser: Adam::new(vec![group(parameters.variables(), stage.discriminator_learning_rate)], betas),
                    discriminator,
                    parameters,
                    loader: Loader::new(Arc::clone(&inputs.dataset), &loader)?,
                    next_batch: 0,
                    source: (Arc::clone(&inputs.dataset), loader),
                })
            })
            .transpose()?;
        Ok(Self {
            average: Average::of(&generator.parameters().within("upsampler"), stage.average_half_life_images)?,
            config: stage,
            seed: config.seed,
            device: inputs.device.clone(),
            generator,
            perceptual: inputs.perceptual.clone(),
            optimiser,
            path_mean: Tensor::zeros((), DType::F32, &inputs.device)?,
            paired,
            adversary,
        })
    }

    /// Losses against the portraits that training codes belong to.
    fn paired_loss(&mut self, step: usize, metrics: &mut Metrics) -> Result<Option<Tensor>> {
        let Some(paired) = &mut self.paired else { return Ok(None) };
        let config = &self.config;
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 0]);
        let render_resolution = self.generator.render_resolution();
        let factor = self.generator.output_resolution() / render_resolution;
        let rows = random.permutation(paired.draws.len());
        let rows = &rows[..config.batch.min(rows.len())];
        let crop = config.crop.min(render_resolution);
        let left = random.below(render_resolution - crop + 1);
        let top = random.below(render_resolution - crop + 1);
        let frames = rows.iter().map(|row| paired.render(&self.generator, *row)).collect::<Result<Vec<_>>>()?;
        let frame = Render::batch(&frames, &self.device)?.crop(left, top, crop)?;
        let draws: Vec<Draw> = rows.iter().map(|row| paired.draws[*row]).collect();
        let resolution = self.generator.output_resolution();
        let batch = paired.portraits.batch(step as u64, &draws)?;
        let target = batch.at(resolution)?.images.to_device(&self.device)?;
        let target =
            target.narrow(2, top * factor, crop * factor)?.narrow(3, left * factor, crop * factor)?.contiguous()?;
        let rows: Vec<u32> = rows.iter().map(|row| *row as u32).collect();
        let codes = paired.codes.codes(&self.generator, &rows)?.detach();
        let output = self.generator.upsample(&frame, &codes, None)?;

        let pixels = (losses::colour_l1(&output.rgb, &target)? * 2.0)?;
        metrics.push("pixels", scalar(&pixels)?);
        let mut total = (&pixels * config.pixels)?;
        if let Some(perceptual) = self.perceptual.as_ref().filter(|_| config.perceptual > 0.0) {
            let [x, y] = [random.below(LARGEST_SHIFT + 1), random.below(LARGEST_SHIFT + 1)];
            let side = crop * factor;
            let side = side - LARGEST_SHIFT;
            let zoom = f64::from(random.range(1.0, config.perceptual_zoom as f32));
            let enlarged = enlargement(side, (side as f64 * zoom).round() as usize, &self.device)?;
            let view = |picture: &Tensor| -> Result<Tensor> {
                let crop = picture.narrow(2, y, side)?.narrow(3, x, side)?.contiguous()?;
                Ok(enlarged.broadcast_matmul(&crop)?.broadcast_matmul(&enlarged.t()?)?)
            };
            let distance = perceptual.distance(&view(&output.rgb)?, &view(&target)?)?.mean_all()?;
            metrics.push("perceptual", scalar(&distance)?);
            total = (total + (distance * config.perceptual)?)?;
        }
        Ok(Some(total))
    }

    /// Trains the discriminator and returns the generator's adversarial loss.
    fn adversarial_loss(&mut self, step: usize, metrics: &mut Metrics) -> Result<Option<Tensor>> {
        let Some(mut adversary) = self.adversary.take() else { return Ok(None) };
        let loss = self.judge(&mut adversary, step, metrics);
        self.adversary = Some(adversary);
        loss.map(Some)
    }

    fn judge(&self, adversary: &mut Adversary, step: usize, metrics: &mut Metrics) -> Result<Tensor> {
        let config = &self.config;
        if step != adversary.next_batch {
            adversary.loader = Loader::resume(Arc::clone(&adversary.source.0), &adversary.source.1, step as u64)?;
        }
        adversary.next_batch = step + 1;
        let real = adversary.loader.next_batch()?;
        let real = real.at(self.generator.output_resolution())?;
        let (real_image, real_masks) = (real.images.to_device(&self.device)?, real.masks.to_device(&self.device)?);
        let fake = self.random_pictures(&mut Stream::new(self.seed, &[STREAM, step as u64, 1]))?;
        let (image, masks) = (fake.rgb.detach(), fake.masks.detach());
        let weights = R1Weights { image: config.r1_image, masks: config.r1_mask };
        let penalty = step.is_multiple_of(config.r1_steps.max(1)).then(|| weights.every(config.r1_steps.max(1)));
        let loss = discriminator_loss(
            &adversary.discriminator,
            Pictures { image: &real_image, masks: &real_masks },
            Pictures { image: &image, masks: &masks },
            Auxiliary::None,
            penalty,
        )?;
        metrics.push("discriminator", scalar(&loss.logistic)?);
        finite(metrics)?;
        adversary.optimiser.step(&loss.total.backward()?, 1.0)?;
        let pictures = Pictures { image: &fake.rgb, masks: &fake.masks };
        let terms = generator_terms(&adversary.discriminator, pictures, Auxiliary::None)?;
        metrics.push("adversarial", scalar(&terms.adversarial)?);
        Ok((terms.total * config.adversarial)?)
    }

    /// Path-length regularisation (StyleGAN2): a step in w moves the picture by about the same amount everywhere.
    fn path_length(&mut self, step: usize, metrics: &mut Metrics) -> Result<Option<Tensor>> {
        let config = &self.config;
        let every = config.path_length_steps.max(1);
        if config.adversarial == 0.0 || config.path_length == 0.0 || !step.is_multiple_of(every) {
            return Ok(None);
        }
        // Only StyleGAN2's synthesis has a graph from latents to picture laid down.
        let Some(Upsampler::StyleGan2(network)) = self.generator.upsampler() else { return Ok(None) };
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 2]);
        let (frame, codes) = self.random_renders((config.batch / PATH_BATCH_SHRINK).max(1), &mut random)?;
        let input = Generator::upsampler_input(&frame)?;
        let latents = network.latents(&self.generator.upsampler_style(&codes, None)?)?;
        let features = network.transfer_features(&input.features)?;
        let noise = Noise::Drawn(&mut random);
        let (output, trace) = network.synthesize_from(&features, &input.masks, &latents, noise)?;
        let pixels = (output.rgb.dim(2)? * output.rgb.dim(3)?) as f64;
        let direction = (random.normal_tensor(output.rgb.dims(), &self.device)? / pixels.sqrt())?;
        let path = PathLength::new(&network.latent_gradient(&trace, &direction)?, &self.path_mean, PATH_DECAY)?;
        metrics.push("path_length", scalar(&path.penalty)?);
        self.path_mean = path.mean;
        Ok(Some((path.penalty * (config.path_length * every as f64))?))
    }

    /// Renders of random portraits from random cameras, and their codes; the field gets no gradient.
    fn random_renders(&self, count: usize, random: &mut Stream) -> Result<(Frame, Tensor)> {
        let z = random.normal_tensor(&[count, self.generator.config().field.style_dim], &self.device)?;
        let codes = codes::broadcast(&self.generator.map(&self.generator.spread(&z)?)?.detach())?;
        let [azimuth, elevation] = self.generator.config().camera_deviation_rad;
        let cameras: Vec<Camera> = (0..count)
            .map(|_| Camera::at(f64::from(random.normal()) * azimuth, f64::from(random.normal()) * elevation))
            .collect();
        let cameras = Camera::parameter_tensor(&cameras, &self.device)?;
        Ok((self.generator.render(&codes, &cameras, &self.generator.render_settings())?, codes))
    }

    /// Finished pictures of random portraits from random cameras.
    fn random_pictures(&self, random: &mut Stream) -> Result<UpsamplerOutput> {
        let (frame, codes) = self.random_renders(self.config.batch, random)?;
        self.generator.upsample_with(&frame, &codes, None, Noise::Drawn(random))
    }
}

impl Paired {
    fn new(config: &TrainConfig, inputs: &Inputs, codes: Option<&PortraitCodes>, resolution: usize) -> Result<Self> {
        let count = inputs.dataset.len();
        let draws: Vec<Draw> = [false, true][..if config.mirror { 2 } else { 1 }]
            .iter()
            .flat_map(|mirrored| (0..count).map(|index| Draw { index, mirrored: *mirrored }))
            .collect();
        let codes = codes.filter(|codes| codes.count() == draws.len()).ok_or_else(|| {
            let reason = "pairs need the codes a warm-up on the same data left beside its model; \
                          run --stage all, or --set upsampler.pixels=0 upsampler.perceptual=0";
            Error::config("upsampler.pixels", reason)
        })?;
        let portraits = Cached::new(&inputs.dataset, &[resolution], &|_| ())?;
        let renders = vec![None; draws.len()];
        Ok(Self { portraits, draws, codes: codes.clone(), renders, kept: 0 })
    }

    /// The render of a training portrait from its own camera.
    fn render(&mut self, generator: &Generator, row: usize) -> Result<Render> {
        if let Some(Some(render)) = self.renders.get(row) {
            return Ok(render.clone());
        }
        let codes = self.codes.codes(generator, &[row as u32])?;
        let camera = self.portraits.camera(self.draws[row]).unwrap_or_default();
        let cameras = Camera::parameter_tensor(&[camera], &generator.device())?;
        let settings = RenderSettings { two_pass: Some(TwoPass::default()), ..generator.render_settings() };
        let render = Render::of(&generator.render(&codes, &cameras, &settings)?)?;
        if self.kept < MOST_KEPT {
            self.kept += 1;
            self.renders[row] = Some(render.clone());
        }
        Ok(render)
    }
}

impl Render {
    fn of(frame: &Frame) -> Result<Self> {
        let features = frame.features.as_ref().ok_or_else(|| Error::config("features", "were not rendered"))?;
        let mut parts = vec![&frame.colour, &frame.masks, &frame.depth, &frame.point, &frame.opacity, features];
        parts.extend(frame.normal.as_ref());
        let values = Tensor::cat(&parts, 1)?.to_dtype(DType::F16)?.detach();
        Ok(Self { values, has_normal: frame.normal.is_some() })
    }

    /// The frame of several renders.
    fn batch(renders: &[Self], device: &Device) -> Result<FrameBatch> {
        let has_normal = renders.iter().all(|render| render.has_normal);
        let values: Vec<&Tensor> = renders.iter().map(|render| &render.values).collect();
        Ok(FrameBatch { values: Tensor::cat(&values, 0)?.to_device(device)?.to_dtype(DType::F32)?, has_normal })
    }
}

struct FrameBatch {
    values: Tensor,
    has_normal: bool,
}

impl FrameBatch {
    /// The square of `side` pixels from (`left`, `top`) of all renders.
    fn crop(&self, left: usize, top: usize, side: usize) -> Result<Frame> {
        let values = self.values.narrow(2, top, side)?.narrow(3, left, side)?;
        let channels = values.dim(1)?;
        let normals = if self.has_normal { 3 } else { 0 };
        let part = |first: usize, count: usize| values.narrow(1, first, count)?.contiguous();
        Ok(Frame {
            colour: part(0, 3)?,
            masks: part(3, 9)?,
            depth: part(12, 1)?,
            point: part(13, 3)?,
            opacity: part(16, 1)?,
            features: Some(part(17, channels - 17 - normals)?),
            normal: if self.has_normal { Some(part(channels - 3, 3)?) } else { None },
        })
    }
}

impl StageRun for UpsamplerStage {
    fn step(&mut self, step: usize) -> Result<Metrics> {
        let mut metrics = Metrics::default();
        let losses = [
            self.paired_loss(step, &mut metrics)?,
            self.adversarial_loss(step, &mut metrics)?,
            self.path_length(step, &mut metrics)?,
        ];
        let total = losses.into_iter().flatten().map(Ok).reduce(|sum: Result<Tensor>, loss| Ok((sum? + loss?)?));
        let total =
            total.ok_or_else(|| Error::config("upsampler", "every loss has weight 0; there is nothing to train"))??;
        finite(&metrics)?;
        let factor = self.config.schedule.factor(step, self.config.steps);
        let norms = self.optimiser.step(&total.backward()?, factor)?;
        metrics.push("gradient_norm", norms.iter().sum());
        self.average.update(&self.generator.parameters().within("upsampler"), self.config.batch)?;
        Ok(metrics)
    }

    fn save(&self, tensors: &mut Tensors) -> Result<()> {
        tensors.extend(self.generator.parameters().snapshot()?);
        self.average.save(tensors);
        tensors.insert(PATH_MEAN.to_owned(), self.path_mean.reshape(1)?);
        if let Some(adversary) = &self.adversary {
            tensors.extend(adversary.parameters.snapshot()?);
            adversary.optimiser.save("adam_discriminator", tensors)?;
        }
        self.optimiser.save("adam", tensors)
    }

    fn load(&mut self, tensors: &Tensors) -> Result<()> {
        self.generator.parameters().restore(tensors)?;
        self.average.load(tensors)?;
        let mean = tensors.get(PATH_MEAN).ok_or_else(|| Error::shape(PATH_MEAN, [1], &[]))?;
        self.path_mean = mean.to_device(&self.device)?.reshape(())?;
        if let Some(adversary) = &mut self.adversary {
            adversary.parameters.restore(tensors)?;
            adversary.optimiser.load("adam_discriminator", tensors)?;
        }
        self.optimiser.load("adam", tensors)
    }

    fn samples(&self) -> Result<RgbImage> {
        let finished = self.finished()?.generator;
        let Some(paired) = &self.paired else { return preview::random_grid(&finished) };
        let count = paired.portraits.len().min(6);
        let rows: Vec<u32> = (0..count).map(|index| (index * paired.portraits.len() / count) as u32).collect();
        let cameras: Vec<Camera> =
            rows.iter().map(|row| paired.portraits.camera(paired.draws[*row as usize]).unwrap_or_default()).collect();
        preview::grid(&finished, &paired.codes.codes(&finished, &rows)?, &cameras)
    }

    fn finished(&self) -> Result<Start> {
        let generator = self.generator.duplicate()?;
        self.average.apply(&generator.parameters().within("upsampler"))?;
        Ok(Start { generator, portrait_codes: self.paired.as_ref().map(|paired| paired.codes.clone()) })
    }
}

/// Bilinear enlargement of a line of `source` pixels to `target` as a matrix `[target, source]`, pixel centres aligned
/// as areas are, edges repeated: a product, so that candle differentiates it.
fn enlargement(source: usize, target: usize, device: &Device) -> Result<Tensor> {
    let mut weights = vec![0f32; target * source];
    for (row, weights) in weights.chunks_exact_mut(source.max(1)).enumerate() {
        let position = (row as f64 + 0.5) * source as f64 / target as f64 - 0.5;
        let position = position.clamp(0.0, (source - 1) as f64);
        let (left, share) = (position as usize, position.fract() as f32);
        weights[left] += 1.0 - share;
        weights[(left + 1).min(source - 1)] += share;
    }
    Ok(Tensor::from_vec(weights, (target, source), device)?)
}

fn scalar(loss: &Tensor) -> Result<f64> {
    Ok(f64::from(loss.to_dtype(DType::F32)?.to_scalar::<f32>()?))
}

fn finite(metrics: &Metrics) -> Result<()> {
    match metrics.first_not_finite() {
        Some(quantity) => Err(Error::not_finite(format!("loss term {quantity}"))),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlargement_keeps_ramps_and_is_the_identity_at_one() {
        let ramp = Tensor::arange(0f32, 8.0, &Device::Cpu).unwrap().reshape((8, 1)).unwrap();
        let at = |target| enlargement(8, target, &Device::Cpu).unwrap().matmul(&ramp).unwrap();
        let values = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(values(at(8)), values(ramp.clone()));
        // Between the outer pixels' centres a ramp stays one: value (row + 1/2) · 8/13 − 1/2.
        for (row, value) in values(at(13)).into_iter().enumerate() {
            let expected = ((row as f32 + 0.5) * 8.0 / 13.0 - 0.5).clamp(0.0, 7.0);
            assert!((value - expected).abs() < 1e-5, "{row}: {value}, {expected}");
        }
    }
}
