//! Stage `upsampler`: the field frozen, the 2D generator learns to lift its renders.
//!
//! Four teachers, mixed by their weights: the portrait a training code belongs to (shared/recipe: every warmed-up
//! portrait's soft render is paired with its sharp photo; L1 and LPIPS on crops), a high-resolution discriminator
//! (the paper's second stage) and a critic on a classifier's features, which judge random portraits and, where there are
//! pairs, their pictures too, and random portraits by themselves: two views agree, and what no photo teaches stays calm.

mod adversary;
mod agreement;
mod calm;
mod critic;
mod pairs;
mod zoom;

use candle_core::{DType, Device, Tensor};
use image::RgbImage;

use self::{
    adversary::{Adversary, Judged},
    calm::Calm,
    critic::{Critic, Seen},
    pairs::{Pairs, Square},
    zoom::Zoom,
};
use crate::{
    camera::Camera,
    error::{Error, Result},
    eval::perceptual::Perceptual,
    model::{
        file::Tensors,
        generator::Generator,
        upsampler::{Noise, Upsampler},
    },
    render::Frame,
    rng::Stream,
    train::{
        adversarial::PathLength,
        average::Average,
        config::{TrainConfig, UpsamplerStageConfig},
        events::Metrics,
        losses,
        optimiser::{Adam, Betas, Group},
        preview,
        team::Team,
        trainer::{Inputs, StageRun, Start},
    },
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x7570_7361;
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
    team: Team,
    generator: Generator,
    average: Average,
    perceptual: Option<Perceptual>,
    optimiser: Adam,
    /// Running mean of path lengths, a scalar.
    path_mean: Tensor,
    pairs: Option<Pairs>,
    adversary: Option<Adversary>,
    critic: Option<Critic>,
}

/// What a step's pairs give: their loss, and what a discriminator and a critic may see of them.
struct PairedPictures {
    loss: Tensor,
    real: Judged,
    fake: Judged,
    /// Photos and pictures, where there is a classifier.
    seen: Option<[Seen; 2]>,
}

/// Renders of random portraits; a person's views in a row.
struct RandomRenders {
    frame: Frame,
    /// `[B, 9, 2, D]`.
    codes: Tensor,
    cameras: Vec<Camera>,
}

/// What random portraits give a step: pictures to judge, and the weighted disagreement of their views.
#[derive(Default)]
struct RandomPictures {
    judged: Option<Judged>,
    seen: Option<Seen>,
    loss: Option<Tensor>,
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
        // A field's stage leaves none, and neither did warm-ups before there were populations.
        let generator = match start.portrait_codes.as_ref().filter(|_| generator.population().is_none()) {
            Some(codes) => codes.population(&generator, config.model.population, config.seed)?,
            None => generator,
        };
        let resolution = wanted.output_resolution;
        let betas = Betas { first: stage.betas[0], second: stage.betas[1] };
        let variables = generator.parameters().within("upsampler").variables();
        let group = Group { variables, learning_rate: stage.learning_rate, largest_gradient_norm: None };
        let optimiser = Adam::new(vec![group], betas).in_team(&inputs.team);
        if (stage.perceptual > 0.0 || stage.critic > 0.0) && inputs.perceptual.is_none() {
            let reason = "needs LPIPS weights; pass --lpips FILE, or --set upsampler.perceptual=0 upsampler.critic=0";
            return Err(Error::config("upsampler.perceptual", reason));
        }
        let pairs = (stage.pixels > 0.0 || stage.perceptual > 0.0 || stage.critic > 0.0)
            .then(|| Pairs::new(config, inputs, start.portrait_codes.as_ref(), resolution))
            .transpose()?;
        let adversary = (stage.adversarial > 0.0)
            .then(|| Adversary::new(config, inputs, resolution, pairs.is_none()))
            .transpose()?;
        let critic = inputs.perceptual.as_ref().filter(|_| stage.critic > 0.0);
        let critic = critic.map(|network| Critic::new(&stage, config.seed, network.backbone(), inputs)).transpose()?;
        let seen = stage.crop.min(wanted.input_resolution) * resolution / wanted.input_resolution;
        if adversary.is_some() && stage.adversarial_crop.min(resolution) > seen {
            let reason = format!("must be at most {seen}, what a crop of {} shows", stage.crop);
            return Err(Error::config("upsampler.adversarial_crop", reason));
        }
        if adversary.is_some() && pairs.is_none() && stage.random_portraits == 0 {
            return Err(Error::config("upsampler.random_portraits", "must be at least 1 where there are no pairs"));
        }
        if stage.teaches_random_portraits() && stage.random_portraits == 0 {
            let reason = "and calm_* look at random portraits; set upsampler.random_portraits";
            return Err(Error::config("upsampler.agreement", reason));
        }
        Ok(Self {
            average: Average::of(&generator.parameters().within("upsampler"), stage.average_half_life_images)?,
            config: stage,
            seed: config.seed,
            device: inputs.device.clone(),
            team: inputs.team.clone(),
            generator,
            perceptual: inputs.perceptual.clone(),
            optimiser,
            path_mean: Tensor::zeros((), DType::F32, &inputs.device)?,
            pairs,
            adversary,
            critic,
        })
    }

    /// Lifts renders of training portraits and compares them with the photos.
    fn paired_pictures(&mut self, step: usize, metrics: &mut Metrics) -> Result<Option<PairedPictures>> {
        let Some(pairs) = &mut self.pairs else { return Ok(None) };
        let config = &self.config;
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 0]);
        let batch = pairs.batch(&self.generator, config.batch, config.crop, step, &mut random)?;
        let output = self.generator.upsample(&batch.frame, &batch.codes, None)?;

        let pixels = (losses::colour_l1(&output.rgb, &batch.photo)? * 2.0)?;
        metrics.push_loss("pixels", &pixels)?;
        let mut loss = (&pixels * config.pixels)?;
        let mut seen = None;
        if let Some(perceptual) = self.perceptual.as_ref().filter(|_| config.perceptual > 0.0 || config.critic > 0.0) {
            let zoom = Zoom::random(batch.photo.dim(2)?, config.perceptual_zoom, &mut random, &self.device)?;
            let [found, expected] = [&output.rgb, &batch.photo].map(|picture| seen_by(perceptual, &zoom, picture));
            let (found, expected) = (found?, expected?);
            let distance = perceptual.feature_distance(&found.features, &expected.features)?.mean_all()?;
            metrics.push_loss("perceptual", &distance)?;
            loss = (loss + (distance * config.perceptual)?)?;
            seen = Some([expected, found]);
        }
        let real = Judged { image: batch.photo, masks: batch.masks };
        let fake = Judged { image: output.rgb, masks: output.masks };
        Ok(Some(PairedPictures { loss, real, fake, seen }))
    }

    /// Pictures of random portraits for the discriminator, and how far their views disagree.
    fn random_pictures(&self, step: usize, metrics: &mut Metrics) -> Result<RandomPictures> {
        let config = &self.config;
        let judged = self.adversary.is_some() || self.critic.is_some();
        if config.random_portraits == 0 || !(judged || config.teaches_random_portraits()) {
            return Ok(RandomPictures::default());
        }
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 1]);
        let views = if config.agreement > 0.0 { agreement::VIEWS } else { 1 };
        let renders = self.random_renders(config.random_portraits, views, &mut random)?;
        let square = Square::random(config.crop, self.generator.render_resolution(), &mut random);
        // Views are compared whole: squares of them would show other parts of the head.
        let (frame, factor) = match config.agreement > 0.0 {
            true => (renders.frame, self.generator.output_resolution() / self.generator.render_resolution()),
            false => (square.of_frame(&renders.frame)?, 1),
        };
        let output = self.generator.upsample_with(&frame, &renders.codes, None, Noise::Drawn(&mut random))?;
        let mut terms = Vec::new();
        if config.agreement > 0.0
            && let Some(loss) = agreement::disagreement(&output.rgb, &frame, &renders.cameras)?
        {
            metrics.push_loss("agreement", &loss)?;
            terms.push((loss * config.agreement)?);
        }
        if config.calm_background > 0.0 || config.calm_detail > 0.0 || config.calm_outline > 0.0 {
            let calm = Calm::of(&output, &frame.colour)?;
            metrics.push_loss("background", &calm.background)?;
            metrics.push_loss("detail", &calm.detail)?;
            metrics.push_loss("outline", &calm.outline)?;
            let inside = ((calm.detail * config.calm_detail)? + (calm.outline * config.calm_outline)?)?;
            terms.push(((calm.background * config.calm_background)? + inside)?);
        }
        let judged = match factor {
            1 => Judged { image: output.rgb, masks: output.masks },
            _ => Judged { image: square.of(&output.rgb, factor)?, masks: square.of(&output.masks, factor)? },
        };
        let seen = self.seen_by_critic(&judged.image, &mut random)?;
        let loss = terms.into_iter().map(Ok).reduce(|sum: Result<Tensor>, term| Ok((sum? + term?)?)).transpose()?;
        Ok(RandomPictures { judged: Some(judged), seen, loss })
    }

    /// What the critic sees of random portraits `[B, 3, side, side]`, if there is one.
    fn seen_by_critic(&self, pictures: &Tensor, random: &mut Stream) -> Result<Option<Seen>> {
        let Some(perceptual) = self.perceptual.as_ref().filter(|_| self.critic.is_some()) else { return Ok(None) };
        let zoom = Zoom::random(pictures.dim(2)?, self.config.perceptual_zoom, random, &self.device)?;
        seen_by(perceptual, &zoom, pictures).map(Some)
    }

    /// Trains the critic and returns what it asks of the generator, weighted; nothing while it still runs ahead alone.
    fn criticism(
        &mut self,
        step: usize,
        pairs: Option<[Seen; 2]>,
        random_portraits: Option<Seen>,
        metrics: &mut Metrics,
    ) -> Result<Option<Tensor>> {
        let (Some(critic), Some([real, fake])) = (&mut self.critic, pairs) else { return Ok(None) };
        let fakes: Vec<Seen> = std::iter::once(fake).chain(random_portraits).collect();
        let asked = critic.judge(&real, &fakes, metrics)?;
        let heard = step >= self.config.discriminator_ahead_steps;
        Ok(if heard { Some((asked * self.config.critic)?) } else { None })
    }

    /// Trains the discriminator and returns the generator's adversarial loss.
    fn adversarial_loss(
        &mut self,
        step: usize,
        paired: Option<(Judged, Judged)>,
        random_portraits: Option<Judged>,
        metrics: &mut Metrics,
    ) -> Result<Option<Tensor>> {
        let Some(adversary) = &mut self.adversary else { return Ok(None) };
        let (real, fake) = match (paired, random_portraits) {
            (Some((real, fake)), Some(random)) => (Some(real), Some(fake.and(&random)?)),
            (Some((real, fake)), None) => (Some(real), Some(fake)),
            (None, random) => (adversary.photos(step)?, random),
        };
        let (Some(real), Some(fake)) = (real, fake) else { return Ok(None) };
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 3]);
        adversary.judge(&self.config, step, [&real, &fake], &mut random, metrics)
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
        let RandomRenders { frame, codes, .. } =
            self.random_renders((config.batch / PATH_BATCH_SHRINK).max(1), 1, &mut random)?;
        let input = Generator::upsampler_input(&frame)?;
        let latents = network.latents(&self.generator.upsampler_style(&codes, None)?)?;
        let features = network.transfer_features(&input.features)?;
        let noise = Noise::Drawn(&mut random);
        let (output, trace) = network.synthesize_from(&features, &input.masks, &latents, noise)?;
        let pixels = (output.rgb.dim(2)? * output.rgb.dim(3)?) as f64;
        let direction = (random.normal_tensor(output.rgb.dims(), &self.device)? / pixels.sqrt())?;
        let path = PathLength::new(&network.latent_gradient(&trace, &direction)?, &self.path_mean, PATH_DECAY)?;
        metrics.push_loss("path_length", &path.penalty)?;
        self.path_mean = self.team.mean(&path.mean)?;
        Ok(Some((path.penalty * (config.path_length * every as f64))?))
    }

    /// Codes `[B, 9, 2, D]` of `people` random portraits without a graph: of the population and, where codes are exchanged
    /// and there are pairs, as often of a training portrait, which its own photo shows from one side alone.
    fn random_codes(&self, people: usize, random: &mut Stream) -> Result<Tensor> {
        let share = self.config.exchanged_codes as f32;
        let mut draw = || -> Result<Tensor> {
            if let Some(pairs) = self.pairs.as_ref().filter(|_| share > 0.0 && random.chance(0.5)) {
                let rows: Vec<u32> = (0..people).map(|_| random.below(pairs.codes().count()) as u32).collect();
                return Ok(pairs.codes().codes(&self.generator, &rows)?.detach());
            }
            let noise = random.normal_tensor(&[people, self.generator.noise_dim()], &self.device)?;
            Ok(self.generator.codes_of(&noise)?.detach())
        };
        let codes = draw()?;
        if share == 0.0 {
            return Ok(codes);
        }
        let others = draw()?;
        let (_, regions, kinds, _) = codes.dims4()?;
        let exchanged = (0..people * regions * kinds).map(|_| u8::from(random.chance(share)));
        let exchanged = Tensor::from_iter(exchanged, &self.device)?.reshape((people, regions, kinds, 1))?;
        Ok(exchanged.broadcast_as(codes.shape())?.where_cond(&others, &codes)?)
    }

    /// Renders of `people` random portraits from `views` random cameras each; the field gets no gradient.
    fn random_renders(&self, people: usize, views: usize, random: &mut Stream) -> Result<RandomRenders> {
        let share = self.team.share();
        let people = share.whole(people);
        let codes = self.random_codes(people, random)?;
        let [azimuth, elevation] = self.generator.config().camera_deviation_rad;
        let mut cameras = Vec::new();
        for _ in 0..people {
            let first = Camera::at(f64::from(random.normal()) * azimuth, f64::from(random.normal()) * elevation);
            cameras.push(first);
            for _ in 1..views {
                cameras.push(agreement::turned(first, self.config.agreement_turn_rad, random));
            }
        }
        let people = share.rows(people);
        let views_of = |person: &usize| person * views..(person + 1) * views;
        let cameras: Vec<Camera> =
            people.iter().filter_map(|person| cameras.get(views_of(person))).flatten().copied().collect();
        let rows: Vec<u32> = people.iter().flat_map(|person| vec![*person as u32; views]).collect();
        let codes = codes.index_select(&Tensor::new(rows, &self.device)?, 0)?;
        let parameters = Camera::parameter_tensor(&cameras, &self.device)?;
        let frame = self.generator.render(&codes, &parameters, &pairs::settings(&self.generator))?;
        Ok(RandomRenders { frame, codes, cameras })
    }
}

impl StageRun for UpsamplerStage {
    fn step(&mut self, step: usize) -> Result<Metrics> {
        let mut metrics = Metrics::default();
        let (paired_loss, pictures, seen) = match self.paired_pictures(step, &mut metrics)? {
            Some(paired) => (Some(paired.loss), Some((paired.real, paired.fake)), paired.seen),
            None => (None, None, None),
        };
        let random = self.random_pictures(step, &mut metrics)?;
        let adversarial = self.adversarial_loss(step, pictures, random.judged, &mut metrics)?;
        let criticism = self.criticism(step, seen, random.seen, &mut metrics)?;
        let losses = [paired_loss, random.loss, adversarial, criticism, self.path_length(step, &mut metrics)?];
        let total = losses.into_iter().flatten().map(Ok).reduce(|sum: Result<Tensor>, loss| Ok((sum? + loss?)?));
        let total = match total {
            Some(total) => total?,
            // The discriminator still runs ahead, and there is nothing else to learn from.
            None if self.adversary.is_some() => return Ok(metrics),
            None => return Err(Error::config("upsampler", "every loss has weight 0; there is nothing to train")),
        };
        metrics.check_finite()?;
        let factor = self.config.schedule.factor(step, self.config.steps);
        let norms = self.optimiser.step(&total.backward()?, factor)?;
        metrics.push("gradient_norm", norms.iter().sum());
        let images = self.team.share().whole(self.config.batch);
        self.average.update(&self.generator.parameters().within("upsampler"), images)?;
        Ok(metrics)
    }

    fn error(&self, metrics: &Metrics) -> Option<f64> {
        let perceptual = metrics.get("perceptual").unwrap_or_default();
        Some(self.config.pixels * metrics.get("pixels")? + self.config.perceptual * perceptual)
    }

    fn save(&self, tensors: &mut Tensors) -> Result<()> {
        tensors.extend(self.generator.parameters().snapshot()?);
        self.average.save(tensors);
        tensors.insert(PATH_MEAN.to_owned(), self.path_mean.reshape(1)?);
        if let Some(adversary) = &self.adversary {
            adversary.save(tensors)?;
        }
        if let Some(critic) = &self.critic {
            critic.save(tensors)?;
        }
        self.optimiser.save("adam", tensors)
    }

    fn load(&mut self, tensors: &Tensors) -> Result<()> {
        self.generator.parameters().restore(tensors)?;
        self.average.load(tensors)?;
        let mean = tensors.get(PATH_MEAN).ok_or_else(|| Error::shape(PATH_MEAN, [1], &[]))?;
        self.path_mean = mean.to_device(&self.device)?.reshape(())?;
        if let Some(adversary) = &mut self.adversary {
            adversary.load(tensors)?;
        }
        if let Some(critic) = &mut self.critic {
            critic.load(tensors)?;
        }
        self.optimiser.load("adam", tensors)
    }

    fn samples(&self) -> Result<RgbImage> {
        let finished = self.finished()?.generator;
        let Some(pairs) = &self.pairs else { return preview::random_grid(&finished) };
        let (rows, cameras) = pairs.spread();
        preview::grid(&finished, &pairs.codes().codes(&finished, &rows)?, &cameras)
    }

    fn finished(&self) -> Result<Start> {
        let generator = self.generator.duplicate()?;
        self.average.apply(&generator.parameters().within("upsampler"))?;
        Ok(Start { generator, portrait_codes: self.pairs.as_ref().map(|pairs| pairs.codes().clone()) })
    }
}

/// Pictures as a classifier sees them in one view.
fn seen_by(perceptual: &Perceptual, zoom: &Zoom, pictures: &Tensor) -> Result<Seen> {
    Ok(Seen { features: perceptual.features(&zoom.of(pictures)?)?, pixels: pictures.clone() })
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{
        data::dataset::Dataset,
        parameters::Parameters,
        train::{config::Preset, portrait_codes::PortraitCodes, test_data::dataset},
    };

    /// A tiny stage with a discriminator, from a field with codes of its own for 4 portraits and their mirror images.
    fn stage(portraits: &Arc<Dataset>, settings: &[&str]) -> UpsamplerStage {
        let mut config = TrainConfig::preset(Preset::Tiny);
        config.upsampler.channel_multiplier = 1.0 / 128.0;
        let settings: Vec<String> = settings.iter().map(|setting| format!("upsampler.{setting}")).collect();
        let mut config = config.with(&settings).unwrap();
        if let Some(upsampler) = config.model.upsampler.as_mut().filter(|_| config.upsampler.critic > 0.0) {
            // The classifier wants pictures of 31 pixels, after shifts.
            (upsampler.output_resolution, upsampler.channels, upsampler.blocks) = (64, vec![8; 3], vec![1; 3]);
        }
        let mut random = Stream::new(4, &[]);
        let start = Start {
            generator: Generator::new(&config.model, &Parameters::fresh(1, DType::F32, &Device::Cpu)).unwrap(),
            portrait_codes: Some(PortraitCodes {
                noise: random.normal_tensor(&[8, config.model.field.style_dim], &Device::Cpu).unwrap(),
                offsets: None,
            }),
        };
        let perceptual = (config.upsampler.critic > 0.0).then(|| Perceptual::of_noise(1).unwrap());
        let inputs = Inputs {
            dataset: Arc::clone(portraits),
            perceptual,
            start: None,
            device: Device::Cpu,
            team: Team::default(),
        };
        UpsamplerStage::new(&config, &inputs, Some(&start)).unwrap()
    }

    /// Everything that changes from step to step.
    fn state(stage: &UpsamplerStage) -> Vec<f64> {
        let mut tensors = Tensors::new();
        stage.save(&mut tensors).unwrap();
        let numbers = |tensor: &Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
        tensors.values().flat_map(|tensor| numbers(tensor).unwrap()).collect()
    }

    #[test]
    fn with_pairs_or_without_a_discriminator_teaches_and_a_stop_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let portraits = dataset(folder.path(), 4);
        let with_pairs = vec!["adversarial=0.1", "discriminator_ahead_steps=2", "random_portraits=1"];
        let alone = vec!["adversarial=1", "pixels=0", "discriminator_ahead_steps=1", "random_portraits=2"];
        let criticised = vec!["critic=0.1", "discriminator_ahead_steps=1", "random_portraits=1"];
        let calm =
            vec!["random_portraits=1", "calm_background=1", "calm_detail=1", "calm_outline=1", "exchanged_codes=0.5"];
        let agreeing = vec!["adversarial=0.1", "discriminator_ahead_steps=0", "random_portraits=2", "agreement=1"];
        let augmented = vec![
            "adversarial=0.1",
            "discriminator_ahead_steps=0",
            "random_portraits=0",
            "augment_target=0.01",
            "augment_ramp_images=20",
        ];
        for (settings, quantities) in [
            (with_pairs, &["pixels", "discriminator", "adversarial"][..]),
            (alone, &["discriminator", "adversarial"][..]),
            (criticised, &["pixels", "perceptual", "critic", "criticised"][..]),
            (calm, &["pixels", "background", "detail", "outline"][..]),
            (agreeing, &["pixels", "discriminator", "adversarial", "agreement"][..]),
            (augmented, &["adversarial", "real_sign", "augment_probability"][..]),
        ] {
            let mut whole = stage(&portraits, &settings);
            let before = state(&whole);
            (0..3).for_each(|step| drop(whole.step(step).unwrap()));
            let metrics = whole.step(3).unwrap();
            for quantity in quantities {
                assert!(metrics.get(quantity).is_some_and(f64::is_finite), "{quantity} of {metrics:?}");
            }
            assert!(state(&whole) != before);
            let mut first = stage(&portraits, &settings);
            (0..2).for_each(|step| drop(first.step(step).unwrap()));
            let mut saved = Tensors::new();
            first.save(&mut saved).unwrap();
            let mut second = stage(&portraits, &settings);
            second.load(&saved).unwrap();
            (2..4).for_each(|step| drop(second.step(step).unwrap()));
            assert!(state(&second) == state(&whole), "a stop changed what was learnt");
        }
    }

    #[test]
    fn the_discriminator_runs_ahead_before_it_is_heard() {
        let folder = tempfile::tempdir().unwrap();
        let mut stage = stage(&dataset(folder.path(), 4), &["adversarial=0.1", "discriminator_ahead_steps=1"]);
        let heard = |metrics: Metrics| metrics.get("adversarial").is_some();
        assert!(!heard(stage.step(0).unwrap()));
        assert!(heard(stage.step(1).unwrap()));
    }
}
