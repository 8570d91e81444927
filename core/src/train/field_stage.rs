//! Stage `field`: the paper's first stage. The field against the global discriminator (realness and view direction)
//! and the semantic one (realness and class of one region), with decoupling, eikonal and minimal-surface losses.

use std::sync::Arc;

use candle_core::{DType, Device, Tensor, Var, backprop::GradStore};
use image::RgbImage;

use crate::{
    camera::{self, Camera},
    codes,
    config::GeneratorConfig,
    data::loader::{Batch, Loader, LoaderConfig},
    error::{Error, Result},
    eval::perceptual::Perceptual,
    model::{
        discriminator::{Discriminator, DiscriminatorConfig, DiscriminatorKind, class_labels, select_masks},
        file::Tensors,
        generator::Generator,
    },
    parameters::Parameters,
    region::{Region, RegionSet},
    render::{Outputs, RayBundle, RayOutput, RenderSettings, render_rays},
    rng::Stream,
    train::{
        adversarial::{Auxiliary, Pictures, R1Weights, discriminator_loss, generator_terms},
        augment::{Augmenter, Purpose},
        average::Average,
        config::{FieldStageConfig, TrainConfig},
        events::Metrics,
        losses::{self, DecouplingRenders, MINIMAL_SURFACE_SHARPNESS},
        optimiser::{Adam, Betas, Group},
        portrait_codes::PortraitCodes,
        preview,
        team::{Share, Team},
        trainer::{Inputs, StageRun, Start},
    },
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x6669_656c;

/// The running stage.
pub struct FieldStage {
    config: FieldStageConfig,
    seed: u64,
    device: Device,
    team: Team,
    dtype: DType,
    loader: Loader,
    next_batch: usize,
    inputs: (Arc<crate::data::dataset::Dataset>, LoaderConfig),
    perceptual: Option<Perceptual>,
    generator: Generator,
    /// Codes of the training portraits from a warm-up, for the stage after this one.
    portrait_codes: Option<PortraitCodes>,
    average: Average,
    global: Discriminator,
    semantic: Discriminator,
    /// The same two, for the generator's step: gradients of their weights would take as much memory as the weights.
    judges: Judges,
    discriminators: Parameters,
    /// Of both discriminators; the global one's verdicts move it.
    augmenter: Augmenter,
    generator_optimiser: Adam,
    discriminator_optimiser: Adam,
}

/// Discriminators that gradients pass through.
struct Judges {
    global: Discriminator,
    semantic: Discriminator,
}

/// Pictures the generator made up, with what they were made from.
struct Fakes {
    /// `[B, 3, r, r]`
    image: Tensor,
    /// `[B, 9, r, r]`
    masks: Tensor,
    /// Azimuth and elevation, `[B, 2]`.
    angles_rad: Tensor,
    output: RayOutput,
}

impl FieldStage {
    /// Fresh discriminators; the generator from `start` or fresh.
    pub fn new(config: &TrainConfig, inputs: &Inputs, start: Option<&Start>) -> Result<Self> {
        Self::with_type(config, inputs, start, DType::F32)
    }

    /// As [`Self::new`]; fresh weights and all arithmetic in `dtype` (f64 is for checking gradients).
    fn with_type(config: &TrainConfig, inputs: &Inputs, start: Option<&Start>, dtype: DType) -> Result<Self> {
        let stage = config.field.clone();
        let generator = match start {
            // Noise goes through the mapping network, which is trained here.
            Some(start) => start.generator.with_upsampler(None, 0)?.with_population(None)?,
            None => {
                let model = GeneratorConfig { upsampler: None, population: 0, ..config.model.clone() };
                Generator::new(&model, &Parameters::fresh(config.seed, dtype, &inputs.device))?
            }
        };
        let discriminators = Parameters::fresh(config.seed, dtype, &inputs.device);
        let discriminator = |kind, name: &str, parameters: &Parameters| {
            let config = DiscriminatorConfig {
                kind,
                resolution: stage.resolution,
                channel_multiplier: stage.channel_multiplier,
            };
            Discriminator::new(&config, &parameters.within(name))
        };
        let pair = |parameters: &Parameters| -> Result<Judges> {
            Ok(Judges {
                global: discriminator(DiscriminatorKind::Global, "global", parameters)?,
                semantic: discriminator(DiscriminatorKind::Semantic, "semantic", parameters)?,
            })
        };
        let Judges { global, semantic } = pair(&discriminators)?;
        let judges = pair(&discriminators.frozen())?;
        let betas = Betas { first: stage.betas[0], second: stage.betas[1] };
        let group = |variables, learning_rate| Group { variables, learning_rate, largest_gradient_norm: None };
        let trained = ["field", "mapping"].iter().flat_map(|name| generator.parameters().within(name).variables());
        let generator_optimiser =
            Adam::new(vec![group(trained.collect(), stage.generator_learning_rate)], betas).in_team(&inputs.team);
        let discriminator_optimiser =
            Adam::new(vec![group(discriminators.variables(), stage.discriminator_learning_rate)], betas)
                .in_team(&inputs.team);
        let loader_config = LoaderConfig {
            resolutions: vec![stage.resolution],
            batch: stage.batch,
            mirror: config.mirror,
            seed: config.seed,
            share: inputs.team.share(),
            ..LoaderConfig::default()
        };
        Ok(Self {
            loader: Loader::new(Arc::clone(&inputs.dataset), &loader_config)?,
            next_batch: 0,
            inputs: (Arc::clone(&inputs.dataset), loader_config),
            perceptual: inputs.perceptual.clone(),
            portrait_codes: start.and_then(|start| start.portrait_codes.clone()),
            average: Average::of(generator.parameters(), stage.average_half_life_images)?,
            augmenter: Augmenter::new(stage.augment_target, stage.augment_ramp_images, config.seed, &inputs.team),
            config: stage,
            seed: config.seed,
            device: inputs.device.clone(),
            team: inputs.team.clone(),
            dtype,
            generator,
            global,
            semantic,
            judges,
            discriminators,
            generator_optimiser,
            discriminator_optimiser,
        })
    }

    /// The real portraits of `step`; after a resume the loader starts where the run stopped.
    fn real(&mut self, step: usize) -> Result<Batch> {
        if step != self.next_batch {
            self.loader = Loader::resume(Arc::clone(&self.inputs.0), &self.inputs.1, step as u64)?;
        }
        self.next_batch = step + 1;
        self.loader.next_batch()
    }

    fn share(&self) -> Share {
        self.team.share()
    }

    /// Portraits in a step of the whole team: what random draws are made for.
    fn whole_batch(&self) -> usize {
        self.share().whole(self.config.batch)
    }

    /// w of fresh portraits of the whole team, `[B, D]`.
    fn draw_w(&self, random: &mut Stream) -> Result<Tensor> {
        let shape = [self.whole_batch(), self.generator.config().field.style_dim];
        let z = random.normal_tensor(&shape, &self.device)?.to_dtype(self.dtype)?;
        self.generator.map(&self.generator.spread(&z)?)
    }

    fn draw_cameras(&self, random: &mut Stream) -> Vec<Camera> {
        let [azimuth, elevation] = self.generator.config().camera_deviation_rad;
        let mut draw = |deviation: f64| f64::from(random.normal()) * deviation;
        let whole: Vec<Camera> = (0..self.whole_batch()).map(|_| Camera::at(draw(azimuth), draw(elevation))).collect();
        self.share().pick(&whole)
    }

    /// Renders codes `[B, 9, 2, D]`; with `outputs.gradient` for the eikonal loss. Every region at every sample: what a
    /// plan leaves out of a picture would be missing from its gradient, and nothing bounds that. The discriminators'
    /// pictures and the generator's are drawn apart, as the authors' are.
    fn render(&self, codes: &Tensor, cameras: &[Camera], outputs: Outputs, random: &mut Stream) -> Result<Fakes> {
        let settings = RenderSettings { resolution: self.config.resolution, ..self.generator.render_settings() };
        let sampling = settings.sampling.with_samples(self.config.samples);
        let field = self.generator.field().portraits(codes)?;
        let parameters = Camera::parameter_tensor(cameras, &self.device)?.to_dtype(self.dtype)?;
        let pixels = camera::pixel_centres(settings.resolution, &self.device)?.to_dtype(self.dtype)?;
        let rays =
            RayBundle::new(camera::cast(&parameters, &pixels, settings.resolution, settings.field_of_view_rad)?)?;
        let (batch, count) = rays.dimensions()?;
        let depths = sampling.perturbed(self.share().whole(batch), count, random, self.dtype, &self.device)?;
        let depths = self.share().of(&depths)?;
        let output = render_rays(&field, &rays, &depths, &sampling, outputs, RegionSet::ALL)?;
        let picture = |rows: &Tensor| rows.reshape((batch, rows.dim(1)?, settings.resolution, settings.resolution));
        Ok(Fakes {
            image: picture(&output.colour)?,
            masks: picture(&output.masks)?,
            angles_rad: parameters.narrow(1, 0, 2)?,
            output,
        })
    }

    /// The discriminators' whole loss at `step`, and the global one's verdicts on the real pictures.
    fn discriminators_loss(&self, real: &Batch, step: usize, metrics: &mut Metrics) -> Result<(Tensor, Tensor)> {
        let level = real.at(self.config.resolution)?;
        let here = |tensor: &Tensor| tensor.to_device(&self.device)?.to_dtype(self.dtype);
        let (real_image, real_masks) = (here(&level.images)?, here(&level.masks)?);
        let pictures = Pictures { image: &real_image, masks: &real_masks };
        let (real_image, real_masks) = self.augmenter.apply(step, Purpose::Real, pictures)?;
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 0]);
        let codes = self.draw_codes(&mut random)?;
        let cameras = self.draw_cameras(&mut random);
        let outputs = Outputs { colour: true, ..Outputs::default() };
        let fakes = self.render(&codes.detach(), &cameras, outputs, &mut random)?;
        let (fake_image, fake_masks) = (fakes.image.detach(), fakes.masks.detach());
        let pictures = Pictures { image: &fake_image, masks: &fake_masks };
        let (fake_image, fake_masks) = self.augmenter.apply(step, Purpose::Fake, pictures)?;
        let penalty = R1Weights { image: self.config.r1_image, masks: self.config.r1_mask };
        let loss = discriminator_loss(
            &self.global,
            Pictures { image: &real_image, masks: &real_masks },
            Pictures { image: &fake_image, masks: &fake_masks },
            Auxiliary::View { angles_rad: &fakes.angles_rad, weight: self.config.view },
            Some(penalty),
        )?;
        metrics.push_loss("global", &loss.logistic)?;
        let (mut total, verdicts) = (loss.total, loss.real);
        if self.config.semantic > 0.0 {
            let regions = self.share().pick(&draw_regions(self.whole_batch(), &mut random));
            let labels = class_labels(&regions, &self.device)?;
            let loss = discriminator_loss(
                &self.semantic,
                Pictures { image: &real_image, masks: &select_masks(&real_masks, &regions)? },
                Pictures { image: &fake_image, masks: &select_masks(&fake_masks, &regions)? },
                Auxiliary::Class { labels: &labels, weight: 1.0 },
                Some(penalty),
            )?;
            metrics.push_loss("semantic", &loss.logistic)?;
            total = (total + loss.total)?;
        }
        metrics.check_finite()?;
        Ok((total, verdicts))
    }

    /// The gradients of the generator's whole loss at `step`; its terms join `metrics`. Errs if one is not finite.
    ///
    /// The whole loss is a sum, so its gradients are too: those of one portrait's terms are taken, and its graph is gone,
    /// before L_STD renders its four.
    pub(crate) fn generator_gradients(&self, step: usize, metrics: &mut Metrics) -> Result<GradStore> {
        let mut random = Stream::new(self.seed, &[STREAM, step as u64, 1]);
        let mut gradients = self.portrait_loss(step, &mut random, metrics)?.backward()?;
        if self.config.decoupling > 0.0 {
            let more = self.weighted_decoupling(&mut random, metrics)?.backward()?;
            for (_, variable) in self.generator.parameters().variables() {
                if let Some(gradient) = more.get(&variable) {
                    let sum = match gradients.get(&variable) {
                        Some(first) => (first + gradient)?,
                        None => gradient.clone(),
                    };
                    gradients.insert(&variable, sum);
                }
            }
        }
        metrics.check_finite()?;
        Ok(gradients)
    }

    fn weighted_decoupling(&self, random: &mut Stream, metrics: &mut Metrics) -> Result<Tensor> {
        let decoupling = self.decoupling(random)?;
        metrics.push_loss("decoupling", &decoupling)?;
        Ok((decoupling * self.config.decoupling)?)
    }

    /// All of the generator's loss but L_STD: one portrait before the discriminators, and its surface.
    fn portrait_loss(&self, step: usize, random: &mut Stream, metrics: &mut Metrics) -> Result<Tensor> {
        let config = &self.config;
        let codes = self.draw_codes(random)?;
        let cameras = self.draw_cameras(random);
        let outputs = Outputs { colour: true, gradient: true, ..Outputs::default() };
        let fakes = self.render(&codes, &cameras, outputs, random)?;
        let pictures = Pictures { image: &fakes.image, masks: &fakes.masks };
        let (image, masks) = self.augmenter.apply(step, Purpose::Generator, pictures)?;
        let mut total = through([&image, &masks], |[image, masks]| {
            let view = Auxiliary::View { angles_rad: &fakes.angles_rad, weight: config.view };
            let terms = generator_terms(&self.judges.global, Pictures { image, masks }, view)?;
            metrics.push_loss("generator", &terms.adversarial)?;
            Ok(terms.total)
        })?;
        if config.semantic > 0.0 {
            let regions = self.share().pick(&draw_regions(self.whole_batch(), random));
            let labels = class_labels(&regions, &self.device)?;
            let masks = select_masks(&masks, &regions)?;
            let loss = through([&image, &masks], |[image, masks]| {
                let class = Auxiliary::Class { labels: &labels, weight: 1.0 };
                let terms = generator_terms(&self.judges.semantic, Pictures { image, masks }, class)?;
                metrics.push_loss("generator_semantic", &terms.adversarial)?;
                Ok((terms.total * config.semantic)?)
            })?;
            total = (total + loss)?;
        }
        let gradient = fakes.output.evaluation.gradient.as_ref();
        let eikonal = losses::eikonal(gradient.ok_or_else(|| Error::config("gradient", "the field gave none"))?)?;
        let minimal_surface = losses::minimal_surface(&fakes.output.evaluation.distance, MINIMAL_SURFACE_SHARPNESS)?;
        metrics.push_loss("eikonal", &eikonal)?;
        metrics.push_loss("minimal_surface", &minimal_surface)?;
        Ok(((total + (eikonal * config.eikonal)?)? + (minimal_surface * config.minimal_surface)?)?)
    }

    /// L_STD: two portraits' shape and texture rows, crossed and rendered from the same cameras.
    fn decoupling(&self, random: &mut Stream) -> Result<Tensor> {
        let first = self.share().of(&codes::broadcast(&self.draw_w(random)?)?)?;
        let second = self.share().of(&codes::broadcast(&self.draw_w(random)?)?)?;
        let cameras = self.draw_cameras(random);
        let cross =
            |shape: &Tensor, texture: &Tensor| Tensor::cat(&[shape.narrow(2, 0, 1)?, texture.narrow(2, 1, 1)?], 2);
        let outputs = Outputs { colour: true, ..Outputs::default() };
        // The same rays for all four, so that masks differ by their codes alone.
        let seed = random.bits();
        let render = |codes: Tensor| self.render(&codes, &cameras, outputs, &mut Stream::new(seed, &[]));
        let own = render(cross(&first, &first)?)?;
        let other_texture = render(cross(&first, &second)?)?;
        let other_shape = render(cross(&second, &first)?)?;
        let other = render(cross(&second, &second)?)?;
        let features = |image: &Tensor| match &self.perceptual {
            Some(perceptual) => perceptual.features(image),
            None => self.judges.global.image_features(image),
        };
        let pictures = [&own.masks, &other_texture.masks, &own.image, &other_shape.image, &other.image];
        through(pictures, |[masks, masks_other_texture, picture, picture_other_shape, picture_other_both]| {
            let renders =
                DecouplingRenders { masks, masks_other_texture, picture, picture_other_shape, picture_other_both };
            losses::shape_texture_decoupling(renders, features, self.config.decoupling_margin)
        })
    }

    /// Codes of fresh portraits, mixed from two w with the configured chance.
    fn draw_codes(&self, random: &mut Stream) -> Result<Tensor> {
        let first = self.draw_w(random)?;
        if random.chance(self.config.mixing as f32) {
            let second = self.draw_w(random)?;
            return self.share().of(&codes::mix(&first, &second, random)?);
        }
        self.share().of(&codes::broadcast(&first)?)
    }
}

impl StageRun for FieldStage {
    fn step(&mut self, step: usize) -> Result<Metrics> {
        let mut metrics = Metrics::default();
        let real = self.real(step)?;
        let (loss, verdicts) = self.discriminators_loss(&real, step, &mut metrics)?;
        let norms = self.discriminator_optimiser.step(&loss.backward()?, 1.0)?;
        metrics.push("discriminator_norm", norms.iter().sum());
        self.augmenter.adapt(&verdicts, &mut metrics)?;
        let gradients = self.generator_gradients(step, &mut metrics)?;
        let norms = self.generator_optimiser.step(&gradients, 1.0)?;
        metrics.push("generator_norm", norms.iter().sum());
        self.average.update(self.generator.parameters(), self.whole_batch())?;
        Ok(metrics)
    }

    fn save(&self, tensors: &mut Tensors) -> Result<()> {
        tensors.extend(self.generator.parameters().snapshot()?);
        tensors.extend(self.discriminators.snapshot()?);
        self.average.save(tensors);
        self.augmenter.save(tensors)?;
        self.generator_optimiser.save("adam_generator", tensors)?;
        self.discriminator_optimiser.save("adam_discriminator", tensors)
    }

    fn load(&mut self, tensors: &Tensors) -> Result<()> {
        self.generator.parameters().restore(tensors)?;
        self.discriminators.restore(tensors)?;
        self.average.load(tensors)?;
        self.augmenter.load(tensors)?;
        self.generator_optimiser.load("adam_generator", tensors)?;
        self.discriminator_optimiser.load("adam_discriminator", tensors)
    }

    fn samples(&self) -> Result<RgbImage> {
        preview::random_grid(&self.finished()?.generator)
    }

    fn finished(&self) -> Result<Start> {
        let generator = self.generator.duplicate()?;
        self.average.apply(generator.parameters())?;
        generator.measure(None)?;
        Ok(Start { generator, portrait_codes: self.portrait_codes.clone() })
    }
}

/// `loss` of `pictures` when its graph, that of a network above them, is gone already: the value of the loss and, to the
/// pictures, its gradient.
fn through<const N: usize>(
    pictures: [&Tensor; N],
    loss: impl FnOnce([&Tensor; N]) -> Result<Tensor>,
) -> Result<Tensor> {
    let leaves = pictures.iter().map(|picture| Var::from_tensor(&picture.detach()));
    let leaves = leaves.collect::<candle_core::Result<Vec<_>>>()?;
    let mut tensors = pictures;
    tensors.iter_mut().zip(&leaves).for_each(|(tensor, leaf)| *tensor = leaf.as_tensor());
    let loss = loss(tensors)?;
    let gradients = loss.backward()?;
    let mut total = loss.detach();
    for (picture, leaf) in pictures.into_iter().zip(&leaves) {
        if let Some(gradient) = gradients.get(leaf) {
            let nothing = (picture - picture.detach())?;
            total = (total + (nothing * gradient.detach())?.sum_all()?)?;
        }
    }
    Ok(total)
}

fn draw_regions(count: usize, random: &mut Stream) -> Vec<Region> {
    (0..count).map(|_| Region::ALL[random.below(Region::ALL.len())]).collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::train::{config::Preset, test_data::dataset};

    /// The tiny preset's stage, all losses on, in f64.
    fn stage(folder: &std::path::Path, model: impl FnOnce(&mut GeneratorConfig)) -> FieldStage {
        let mut config = TrainConfig::preset(Preset::Tiny);
        (config.model.field.style_dim, config.model.field.width) = (6, 6);
        (config.field.samples, config.field.mixing) = (4, 1.0);
        // Far above the distance of untrained pictures, so that the margin's hinge is open and its gradient counts.
        config.field.decoupling_margin = 10.0;
        model(&mut config.model);
        let inputs = Inputs {
            dataset: dataset(folder, 6),
            perceptual: None,
            start: None,
            device: Device::Cpu,
            team: Team::default(),
        };
        let stage = FieldStage::with_type(&config, &inputs, None, DType::F64).unwrap();
        // Fresh biases are zero and so are most masks: activations would sit exactly on the kink of their leaky ReLU.
        let mut random = Stream::new(1, &[]);
        for (_, variable) in stage.discriminators.variables() {
            let noise = random.normal_tensor(variable.dims(), &Device::Cpu).unwrap().to_dtype(DType::F64).unwrap();
            variable.set(&(variable.as_tensor() + (noise * 0.05).unwrap()).unwrap()).unwrap();
        }
        stage
    }

    /// Compares autograd with central differences along a random direction of each group of variables.
    fn check(title: &str, variables: Vec<(String, Var)>, gradients: &GradStore, value: impl Fn() -> f64) {
        const STEP: f64 = 1e-8;
        let mut groups: BTreeMap<String, Vec<Var>> = BTreeMap::new();
        for (name, variable) in variables.into_iter().filter(|(name, _)| !name.starts_with("statistics")) {
            let group: Vec<&str> = name.split('.').take(2).collect();
            groups.entry(group.join(".")).or_default().push(variable);
        }
        let (mut moved_any, scale) = (0, value().abs());
        for (seed, (name, variables)) in groups.iter().enumerate() {
            let mut random = Stream::new(seed as u64, &[]);
            let draw = |variable: &Var| {
                random.normal_tensor(variable.dims(), &Device::Cpu)?.to_dtype(DType::F64).map_err(Error::from)
            };
            let directions: Vec<Tensor> = variables.iter().map(draw).collect::<Result<_>>().unwrap();
            let starts: Vec<Tensor> = variables.iter().map(|variable| variable.copy().unwrap()).collect();
            let moved = |step: f64| {
                for ((variable, start), direction) in variables.iter().zip(&starts).zip(&directions) {
                    variable.set(&(start + (direction * step).unwrap()).unwrap()).unwrap();
                }
                value()
            };
            let difference = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            moved(0.0);
            let automatic: f64 = variables
                .iter()
                .zip(&directions)
                .filter_map(|(variable, direction)| Some((gradients.get(variable)? * direction).unwrap()))
                .map(|product| product.sum_all().unwrap().to_scalar::<f64>().unwrap())
                .sum();
            let error = (automatic - difference).abs() / (difference.abs() + 1e-3 * scale);
            println!(
                "{title:<22} {name:<24} autograd {automatic:>12.5e}  difference {difference:>12.5e}  error {error:.1e}"
            );
            // Differences of step 1e-8 in f64 round at about 1e-16 / 1e-8 of the loss; longer ones would cross kinks of
            // leaky ReLUs, where R1's gradient jumps. A wrong term would show at 1e-2 and above.
            assert!(error < 1e-4, "{title} {name}: autograd {automatic}, finite difference {difference}");
            moved_any += usize::from(difference != 0.0);
        }
        assert!(moved_any * 2 > groups.len(), "most of the weights should act on the loss");
    }

    #[test]
    fn gradients_of_the_whole_step_match_finite_differences() {
        let paper = |model: &mut GeneratorConfig| {
            model.field = crate::config::FieldConfig { style_dim: 6, width: 6, ..crate::config::FieldConfig::paper() };
        };
        let folder = tempfile::tempdir().unwrap();
        let ours = stage(&folder.path().join("ours"), |_| ());
        let theirs = stage(&folder.path().join("paper"), paper);
        let mut augmented = stage(&folder.path().join("augmented"), |_| ());
        augmented.augmenter = Augmenter::new(0.6, 100, 7, &Team::default()).with_probability(0.8);
        for (form, mut stage) in [("ours", ours), ("paper", theirs), ("augmented", augmented)] {
            let real = stage.real(0).unwrap();
            let value = |loss: Tensor| loss.to_scalar::<f64>().unwrap();
            let discriminators = || stage.discriminators_loss(&real, 0, &mut Metrics::default()).unwrap().0;
            let gradients = discriminators().backward().unwrap();
            let variables = stage.discriminators.variables();
            check(&format!("{form}, discriminators"), variables, &gradients, || value(discriminators()));

            let gradients = stage.generator_gradients(0, &mut Metrics::default()).unwrap();
            for (name, variable) in stage.discriminators.variables() {
                assert!(gradients.get(&variable).is_none(), "{name} is not the generator's to learn");
            }
            let generator = || {
                let mut random = Stream::new(stage.seed, &[STREAM, 0, 1]);
                let portrait = stage.portrait_loss(0, &mut random, &mut Metrics::default()).unwrap();
                value(portrait) + value(stage.weighted_decoupling(&mut random, &mut Metrics::default()).unwrap())
            };
            let variables = stage.generator.parameters().variables();
            check(&format!("{form}, generator"), variables, &gradients, generator);
        }
    }

    #[test]
    fn augmentation_rises_and_a_stop_changes_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let portraits = dataset(folder.path(), 6);
        let stage = || {
            let settings = ["field.augment_target=0.01", "field.augment_ramp_images=20", "field.decoupling=0"];
            let config = TrainConfig::preset(Preset::Tiny).with(&settings.map(str::to_owned)).unwrap();
            let inputs = Inputs {
                dataset: Arc::clone(&portraits),
                perceptual: None,
                start: None,
                device: Device::Cpu,
                team: Team::default(),
            };
            let mut stage = FieldStage::with_type(&config, &inputs, None, DType::F32).unwrap();
            // p moves only after four steps: enough of it from the start that pictures change.
            stage.augmenter = stage.augmenter.with_probability(0.5);
            stage
        };
        let state = |stage: &FieldStage| {
            let mut tensors = Tensors::new();
            stage.save(&mut tensors).unwrap();
            let numbers = |tensor: &Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
            tensors.values().flat_map(|tensor| numbers(tensor).unwrap()).collect::<Vec<f64>>()
        };
        let mut whole = stage();
        (0..4).for_each(|step| drop(whole.step(step).unwrap()));
        let metrics = whole.step(4).unwrap();
        assert!(metrics.get("augment_probability").is_some_and(|p| p != 0.5), "{metrics:?}");
        let mut first = stage();
        (0..2).for_each(|step| drop(first.step(step).unwrap()));
        let mut saved = Tensors::new();
        first.save(&mut saved).unwrap();
        let mut second = stage();
        second.load(&saved).unwrap();
        (2..5).for_each(|step| drop(second.step(step).unwrap()));
        assert!(state(&second) == state(&whole), "a stop changed what was learnt");
    }
}
