//! Stage `warmup`: every training portrait gets a code of its own and is reconstructed from its known camera
//! (shared/recipe). Random rays of random portraits a step; codes, mapping and field learn together.

use std::sync::Arc;

use candle_core::{DType, Device, Tensor, Var};
use image::RgbImage;

use crate::{
    camera::{self, Camera},
    codes,
    config::Background,
    data::{dataset::Dataset, loader::Cached, picture::signed},
    error::{Error, Result},
    model::{file::Tensors, generator::Generator},
    parameters::Parameters,
    region::{REGION_COUNT, Region, RegionSet},
    render::{Outputs, RadianceField as _, RayBundle, Sampling, render_rays},
    rng::Stream,
    train::{
        config::{TrainConfig, WarmupConfig},
        events::Metrics,
        losses::{self, MINIMAL_SURFACE_SHARPNESS, RegionColours},
        optimiser::{Adam, Betas, Group},
        people::People,
        portrait_codes::{PortraitCodes, RowTable},
        preview,
        team::Team,
        trainer::{Inputs, StageRun, Start},
        whiten::whiten,
    },
};

/// Resolution at which portraits are compared to find their first codes, pixels.
const CODE_RESOLUTION: usize = 32;
/// Weight of a mask value beside a colour value in that comparison (recipe).
const CODE_MASK_WEIGHT: f32 = 0.7;
/// Squared mask errors of small regions count more (recipe), in label order.
const MASK_WEIGHTS: [f64; REGION_COUNT] = [1.0, 1.0, 3.0, 3.0, 3.0, 2.0, 2.0, 1.0, 1.0];
/// Points of the eikonal loss are moved off the rays' samples by this, world units.
const EIKONAL_SPREAD: f64 = 0.0036;
/// A region counts as present in a portrait from this many pixels of its 32² mask on.
const PRESENT_PIXELS: f32 = 1.5;

/// Names of the codes in checkpoints.
const CODES: &str = "codes";
const REGION_CODES: &str = "region_codes";
/// The first element of every stream drawn here.
const STREAM: u64 = 0x7761_726d;

/// The running stage.
pub struct Warmup {
    config: WarmupConfig,
    seed: u64,
    /// Components wanted of the codes.
    population: usize,
    device: Device,
    team: Team,
    portraits: Cached,
    people: People,
    generator: Generator,
    /// `generator` as the losses see it: without gradients of its weights where these do not learn.
    reader: Generator,
    log_alpha: Var,
    /// z of every person, then of every mirrored one, `[M, D]`.
    codes: Var,
    /// What every region of every person adds to its mapped z, `[M, 9, 2, D]`; none if the configuration wants none.
    region_codes: Option<RowTable>,
    betas: Betas,
    /// Mean colour in [-1, 1] of each region of each picture, as stored and mirrored, `[P, 9, 3]`.
    region_colours: Tensor,
    /// 1 where a region is present, `[P, 9]`.
    present: Tensor,
    optimiser: Adam,
}

impl Warmup {
    /// Decodes the dataset and sets the codes to the portraits' whitened coordinates.
    pub fn new(config: &TrainConfig, inputs: &Inputs, start: Option<&Start>) -> Result<Self> {
        let stage = config.warmup.clone();
        let mut resolutions = vec![CODE_RESOLUTION, stage.resolutions[0], stage.resolutions[1]];
        resolutions.sort_unstable();
        resolutions.dedup();
        let portraits = Cached::new(&inputs.dataset, &resolutions, &|_| ())?;
        let generator = match start {
            // Its upsampler comes along unmoved, for the stage that goes on with it.
            Some(start) => start.generator.with_population(None)?,
            None => {
                let model = crate::config::GeneratorConfig { upsampler: None, population: 0, ..config.model.clone() };
                Generator::new(&model, &Parameters::fresh(config.seed, DType::F32, &inputs.device))?
            }
        };
        let people = People::of(&inputs.dataset, config.mirror);
        let (features, region_colours, present) = describe(&portraits, &people, &inputs.device)?;
        let style_dim = generator.config().field.style_dim;
        let known =
            start.and_then(|start| start.portrait_codes.as_ref()).filter(|known| known.count() == people.count());
        let codes = match known {
            Some(known) => known.noise.copy()?,
            None => whiten(&features, style_dim, config.seed)?,
        };
        let codes = Var::from_tensor(&codes)?;
        let mut region_codes =
            (stage.region_codes_from < 1.0).then(|| RowTable::zeros(people.count(), &[REGION_COUNT, 2, style_dim]));
        if let (Some(table), Some(offsets)) = (&mut region_codes, known.and_then(|known| known.offsets.as_ref())) {
            table.set(offsets)?;
        }

        let under = |prefix: &str| generator.parameters().within(prefix).variables();
        let (alpha, field): (Vec<_>, Vec<_>) =
            under("field").into_iter().partition(|(name, _)| name.ends_with("log_alpha"));
        let log_alpha = alpha.into_iter().next().map(|(_, variable)| variable);
        let log_alpha = log_alpha.ok_or_else(|| Error::shape("field.log_alpha", [1], &[]))?;
        let group = |variables, learning_rate, bound| Group { variables, learning_rate, largest_gradient_norm: bound };
        let mut groups = vec![group(vec![(CODES.to_owned(), codes.clone())], stage.code_learning_rate, None)];
        let reader = if stage.learning_rate > 0.0 {
            groups.insert(0, group(field, stage.learning_rate, Some(stage.gradient_bound)));
            groups.insert(1, group(under("mapping"), stage.learning_rate, None));
            generator.clone()
        } else {
            Generator::new(generator.config(), &generator.parameters().frozen())?
        };
        let betas = Betas { first: stage.betas[0], second: stage.betas[1] };
        let optimiser = Adam::new(groups, betas).in_team(&inputs.team);
        inputs.team.portraits(stage.batch, people.count())?;
        Ok(Self {
            config: stage,
            seed: config.seed,
            population: config.model.population,
            device: inputs.device.clone(),
            team: inputs.team.clone(),
            portraits,
            people,
            generator,
            reader,
            log_alpha,
            codes,
            region_codes,
            betas,
            region_colours,
            present,
            optimiser,
        })
    }

    /// Rays of one step and what they should see.
    fn draw(&self, step: usize, progress: f64) -> Result<Batch> {
        let config = &self.config;
        let mut random = Stream::new(self.seed, &[STREAM, step as u64]);
        let second = progress >= config.first_resolution_share;
        let resolution = config.resolutions[usize::from(second)];
        let level = self.portraits.level(resolution)?;
        let order = random.permutation(self.people.count());
        let share = self.team.share();
        let whole: Vec<u32> = order
            .into_iter()
            .take(self.team.portraits(config.batch, self.people.count())?)
            .map(|row| row as u32)
            .collect();
        let own = share.rows(whole.len());
        let batch = own.len();
        let rays = config.rays.min(resolution * resolution);

        let (mut pixels, mut colours, mut masks) = (Vec::new(), Vec::new(), Vec::new());
        let (mut cameras, mut rows, mut pictures) = (Vec::new(), Vec::new(), Vec::new());
        for (place, row) in whole.iter().enumerate() {
            let draw = self.people.view(*row as usize, &mut random);
            let is_own = own.contains(&place);
            if is_own {
                rows.push(*row);
                pictures.push(self.people.place(draw) as u32);
                cameras.push(self.portraits.camera(draw).unwrap_or_default());
            }
            // Weighted draws without replacement: the largest u^(1/w) win (Efraimidis and Spirakis, 2006).
            let mut keys: Vec<(f32, usize)> = Vec::with_capacity(resolution * resolution);
            for pixel in 0..resolution * resolution {
                let shares =
                    level.pixel(draw, pixel % resolution, pixel / resolution).map_or([0; REGION_COUNT], |p| p.1);
                let detail: f32 =
                    shares[Region::Eyes.index()..=Region::Ears.index()].iter().map(|s| f32::from(*s)).sum();
                let weight = 1.0 + config.detail_boost as f32 * detail / 255.0;
                keys.push((random.uniform().max(1e-12).ln() / weight, pixel));
            }
            keys.select_nth_unstable_by(rays - 1, |left, right| right.0.total_cmp(&left.0));
            let start = masks.len();
            if is_own {
                masks.resize(start + REGION_COUNT * rays, 0.0);
            }
            for (ray, (_, pixel)) in keys.iter().take(rays).enumerate() {
                let (x, y) = (pixel % resolution, pixel / resolution);
                let jitter = config.pixel_jitter as f32;
                let [shift_x, shift_y] = [random.range(-jitter, jitter), random.range(-jitter, jitter)];
                if !is_own {
                    continue;
                }
                pixels.push(x as f32 + 0.5 + shift_x);
                pixels.push(y as f32 + 0.5 + shift_y);
                let (colour, shares) = level.pixel(draw, x, y).unwrap_or_default();
                colours.extend(colour.map(signed));
                for (region, share) in shares.into_iter().enumerate() {
                    masks[start + region * rays + ray] = f32::from(share) / 255.0;
                }
            }
        }
        let device = &self.device;
        Ok(Batch {
            resolution,
            region_codes: self
                .region_codes
                .as_ref()
                .filter(|_| progress >= config.region_codes_from)
                .map(|table| table.gather(&rows, device))
                .transpose()?,
            whole_rows: whole,
            rows: Tensor::from_vec(rows, batch, device)?,
            pictures: Tensor::from_vec(pictures, batch, device)?,
            cameras: Camera::parameter_tensor(&cameras, device)?,
            pixels: Tensor::from_vec(pixels, (batch, rays, 2), device)?,
            colours: Tensor::from_vec(colours, (batch, rays, 3), device)?.transpose(1, 2)?.contiguous()?,
            masks: Tensor::from_vec(masks, (batch, REGION_COUNT, rays), device)?,
            random,
        })
    }

    fn losses(&self, batch: &mut Batch) -> Result<(Tensor, Metrics)> {
        let config = &self.config;
        let weights = &config.weights;
        let z = self.codes.as_tensor().index_select(&batch.rows, 0)?;
        let mut codes = codes::broadcast(&self.reader.map(&z)?)?;
        if let Some(offsets) = &batch.region_codes {
            codes = (codes + offsets.as_tensor())?;
        }
        let field = self.reader.field().portraits(&codes)?;
        let rays = camera::cast(&batch.cameras, &batch.pixels, batch.resolution, camera::FIELD_OF_VIEW_RAD)?;
        let bundle = RayBundle::new(rays)?;
        let sampling = self.sampling();
        let (count, ray_count) = bundle.dimensions()?;
        let share = self.team.share();
        let whole = share.whole(count);
        let depths = sampling.perturbed(whole, ray_count, &mut batch.random, DType::F32, &self.device)?;
        let depths = share.of(&depths)?;
        let outputs = Outputs { colour: true, ..Outputs::default() };
        let output = render_rays(&field, &bundle, &depths, &sampling, outputs, RegionSet::ALL)?;

        let colour = losses::colour_l1(&output.colour, &batch.colours)?;
        let masks = losses::masks_l2(&output.masks, &batch.masks, &MASK_WEIGHTS)?;
        // Where the background is a region of the volume, nothing is left behind it, and its mask says the same.
        let opacity = match self.background() {
            Background::FarPlane => {
                let foreground = batch.masks.narrow(1, 0, 1)?.squeeze(1)?.affine(-1.0, 1.0)?;
                losses::opacity(&output.weights.remaining.affine(-1.0, 1.0)?, &foreground)?
            }
            Background::Field => Tensor::zeros((), DType::F32, &self.device)?,
        };
        let minimal_surface = losses::minimal_surface(&output.evaluation.distance, MINIMAL_SURFACE_SHARPNESS)?;
        let colours =
            output.evaluation.colours.as_ref().ok_or_else(|| Error::config("fill", "the field gave no colours"))?;
        let fill = losses::fill(colours, &output.weights, &self.region_colours(batch, colours.dim(1)?)?)?;
        let points = self.eikonal_points(batch, &bundle.points(&depths)?)?;
        let gradient = field.evaluate(&points, None, Outputs { gradient: true, ..Outputs::default() })?.gradient;
        let gradient = gradient.ok_or_else(|| Error::config("gradient", "the field gave none"))?;
        let eikonal = losses::eikonal(&gradient)?;
        let code_norm = losses::latent(&z)?;
        let region_code_norm = batch.region_codes.as_ref().map(|offsets| losses::latent(offsets)).transpose()?;

        let mut metrics = Metrics::default();
        let mut total = Tensor::zeros((), DType::F32, &self.device)?;
        for (name, weight, loss) in [
            ("colour", weights.colour, &colour),
            ("masks", weights.masks, &masks),
            ("opacity", weights.opacity, &opacity),
            ("eikonal", weights.eikonal, &eikonal),
            ("minimal_surface", weights.minimal_surface, &minimal_surface),
            ("fill", weights.fill, &fill),
            ("code_norm", weights.code_norm, &code_norm),
        ] {
            total = (total + (loss * weight)?)?;
            metrics.push(name, f64::from(loss.to_scalar::<f32>()?));
        }
        if let Some(loss) = &region_code_norm {
            total = (total + (loss * weights.region_code_norm)?)?;
            metrics.push("region_code_norm", f64::from(loss.to_scalar::<f32>()?));
        }
        Ok((total, metrics))
    }

    /// The regions' mean colours and masks for the fill loss.
    fn region_colours(&self, batch: &Batch, volume: usize) -> Result<RegionColours> {
        let first = REGION_COUNT - volume;
        Ok(RegionColours {
            mean: self.region_colours.index_select(&batch.pictures, 0)?.narrow(1, first, volume)?,
            present: self.present.index_select(&batch.pictures, 0)?.narrow(1, first, volume)?,
            masks: batch.masks.narrow(1, first, volume)?,
        })
    }

    /// Some of the samples `[B, N, 3]`, moved a little at random.
    fn eikonal_points(&self, batch: &mut Batch, points: &Tensor) -> Result<Tensor> {
        let (portraits, available, _) = points.dims3()?;
        let count = ((available as f64 * self.config.eikonal_share) as usize).clamp(1, available);
        let chosen: Vec<u32> = (0..count).map(|_| batch.random.below(available) as u32).collect();
        let chosen = points.detach().index_select(&Tensor::from_vec(chosen, count, &self.device)?, 1)?;
        let share = self.team.share();
        let noise = share.of(&batch.random.normal_tensor(&[share.whole(portraits), count, 3], &self.device)?)?;
        Ok((chosen + (noise * EIKONAL_SPREAD)?)?)
    }

    fn background(&self) -> Background {
        self.generator.config().field.background
    }

    fn sampling(&self) -> Sampling {
        if self.background() == Background::Field {
            return Sampling::closed(self.config.samples);
        }
        let [near, far] = self.config.depth_range;
        let samples = self.config.samples;
        Sampling {
            near,
            far,
            last_interval: Some((far - near) / samples as f64),
            ..Sampling::behind_the_surface(samples)
        }
    }

    fn portrait_codes(&self) -> Result<PortraitCodes> {
        let offsets =
            self.region_codes.as_ref().map(|table| -> Result<Tensor> { Ok(table.tensor()?.to_device(&self.device)?) });
        Ok(PortraitCodes { noise: self.codes.as_tensor().copy()?.detach(), offsets: offsets.transpose()? })
    }

    fn set_alpha(&self, progress: f64) -> Result<()> {
        let [from, to] = self.config.alpha;
        let moved = (progress / self.config.alpha_hold.max(1e-9)).min(1.0);
        let log_alpha = from.ln() + (to.ln() - from.ln()) * moved;
        Ok(self.log_alpha.set(&Tensor::full(log_alpha as f32, self.log_alpha.shape(), &self.device)?)?)
    }
}

struct Batch {
    resolution: usize,
    /// Rows of the codes.
    rows: Tensor,
    /// Places among the pictures.
    pictures: Tensor,
    /// Rows of the codes that the whole team's step takes; `rows` are this process's.
    whole_rows: Vec<u32>,
    /// The rows' share of the table, to differentiate by: `[B, 9, 2, D]`.
    region_codes: Option<Var>,
    cameras: Tensor,
    /// `[B, R, 2]`
    pixels: Tensor,
    /// `[B, 3, R]` in [-1, 1]
    colours: Tensor,
    /// `[B, 9, R]`
    masks: Tensor,
    random: Stream,
}

impl StageRun for Warmup {
    fn step(&mut self, step: usize) -> Result<Metrics> {
        let progress = step as f64 / self.config.steps as f64;
        self.set_alpha(progress)?;
        let mut batch = self.draw(step, progress)?;
        let (loss, mut metrics) = self.losses(&mut batch)?;
        if let Some(quantity) = metrics.first_not_finite() {
            return Err(Error::not_finite(format!("loss term {quantity}")));
        }
        let factor = self.config.schedule.factor(step, self.config.steps);
        let gradients = loss.backward()?;
        let norms = self.optimiser.step(&gradients, factor)?;
        if let (Some(table), Some(gathered)) = (&mut self.region_codes, &batch.region_codes)
            && let Some(gradient) = gradients.get(gathered)
        {
            let gradient = self.team.gather(gradient)?;
            table.step(&batch.whole_rows, &gradient, self.config.region_code_learning_rate * factor, self.betas)?;
        }
        metrics.push("gradient_norm", norms.first().copied().unwrap_or(0.0));
        Ok(metrics)
    }

    fn error(&self, metrics: &Metrics) -> Option<f64> {
        metrics.get("colour")
    }

    fn save(&self, tensors: &mut Tensors) -> Result<()> {
        tensors.extend(self.generator.parameters().snapshot()?);
        tensors.insert(CODES.to_owned(), self.codes.as_tensor().clone());
        // Before they are unlocked they are zeros, which a checkpoint need not hold.
        if let Some(table) = self.region_codes.as_ref().filter(|table| table.is_touched()) {
            table.save(REGION_CODES, tensors)?;
        }
        self.optimiser.save("adam", tensors)
    }

    fn load(&mut self, tensors: &Tensors) -> Result<()> {
        self.generator.parameters().restore(tensors)?;
        let codes = tensors.get(CODES).ok_or_else(|| Error::shape(CODES, self.codes.dims(), &[]))?;
        if codes.dims() != self.codes.dims() {
            return Err(Error::shape(CODES, self.codes.dims(), codes.dims()));
        }
        self.codes.set(&codes.to_device(&self.device)?)?;
        if let Some(table) = &mut self.region_codes
            && tensors.keys().any(|name| name.starts_with(REGION_CODES))
        {
            table.load(REGION_CODES, tensors)?;
        }
        self.optimiser.load("adam", tensors)
    }

    fn samples(&self) -> Result<RgbImage> {
        let (rows, cameras) = preview::spread(&self.people, &self.portraits);
        let trained = self.portrait_codes()?.codes(&self.generator, &rows)?;
        preview::grid(&self.finished()?.generator, &trained, &cameras)
    }

    fn finished(&self) -> Result<Start> {
        let generator = self.generator.duplicate()?;
        generator.measure(Some(self.codes.as_tensor()))?;
        let codes = self.portrait_codes()?;
        let generator = codes.population(&generator, self.population, self.seed)?;
        Ok(Start { generator, portrait_codes: Some(codes) })
    }
}

/// The z a warm-up on `dataset` begins with, `[M, style_dim]`, mirror images after plain ones.
///
/// # Errors
/// Where a picture cannot be read, or there are too few for codes of this length.
pub fn first_noise(dataset: &Arc<Dataset>, mirror: bool, style_dim: usize, seed: u64) -> Result<Tensor> {
    let portraits = Cached::new(dataset, &[CODE_RESOLUTION], &|_| ())?;
    let (features, ..) = describe(&portraits, &People::of(dataset, mirror), &Device::Cpu)?;
    whiten(&features, style_dim, seed)
}

/// What first codes are computed from, the mean of a person's views, `[M, F]`; and each region's mean colour `[P, 9, 3]`
/// and presence `[P, 9]` in every picture.
fn describe(portraits: &Cached, people: &People, device: &Device) -> Result<(Tensor, Tensor, Tensor)> {
    let level = portraits.level(CODE_RESOLUTION)?;
    let (mut features, mut colours, mut present) = (Vec::new(), Vec::new(), Vec::new());
    for draw in people.pictures() {
        let mut sums = [[0f32; 3]; REGION_COUNT];
        let mut areas = [0f32; REGION_COUNT];
        for pixel in 0..CODE_RESOLUTION * CODE_RESOLUTION {
            let (x, y) = (pixel % CODE_RESOLUTION, pixel / CODE_RESOLUTION);
            let (colour, shares) = level.pixel(draw, x, y).unwrap_or_default();
            let colour = colour.map(signed);
            features.extend(colour.map(|value| 0.5 * value));
            for (region, share) in shares.into_iter().enumerate() {
                let share = f32::from(share) / 255.0;
                features.push(CODE_MASK_WEIGHT * share);
                areas[region] += share;
                for channel in 0..3 {
                    sums[region][channel] += share * colour[channel];
                }
            }
        }
        for (sum, area) in sums.iter().zip(areas) {
            colours.extend(sum.map(|value| value / (area + 1e-3)));
            present.push(f32::from(u8::from(area > PRESENT_PIXELS)));
        }
    }
    let columns = CODE_RESOLUTION * CODE_RESOLUTION * (3 + REGION_COUNT);
    let count = people.pictures().len();
    Ok((
        people.mean_of_views(&Tensor::from_vec(features, (count, columns), device)?)?,
        Tensor::from_vec(colours, (count, REGION_COUNT, 3), device)?,
        Tensor::from_vec(present, (count, REGION_COUNT), device)?,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::train::{config::Preset, test_data::dataset};

    fn stage(folder: &std::path::Path) -> Warmup {
        let mut config = TrainConfig::preset(Preset::Tiny);
        config.model.field.style_dim = 6;
        let inputs = Inputs {
            dataset: dataset(folder, 9),
            perceptual: None,
            start: None,
            device: Device::Cpu,
            team: Team::default(),
        };
        Warmup::new(&config, &inputs, None).unwrap()
    }

    #[test]
    fn the_upsampler_of_the_start_comes_along_unmoved() {
        let folder = tempfile::tempdir().unwrap();
        let config = TrainConfig::preset(Preset::Tiny);
        let generator = Generator::new(&config.model, &Parameters::fresh(1, DType::F32, &Device::Cpu)).unwrap();
        let weights = |generator: &Generator| generator.parameters().within("upsampler").snapshot().unwrap();
        let before = weights(&generator);
        let start = Start { generator, portrait_codes: None };
        let (dataset, device, team) = (dataset(folder.path(), 9), Device::Cpu, Team::default());
        let inputs = Inputs { dataset, perceptual: None, start: None, device, team };
        let mut stage = Warmup::new(&config, &inputs, Some(&start)).unwrap();
        stage.step(0).unwrap();
        let after = stage.finished().unwrap().generator;
        assert_eq!(after.config().upsampler, config.model.upsampler);
        let after = weights(&after);
        assert!(!before.is_empty() && before.len() == after.len());
        for (name, weight) in &before {
            let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert_eq!(values(weight), values(&after[name]), "{name}");
        }
    }

    #[test]
    fn without_a_learning_rate_codes_alone_are_fitted() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = TrainConfig::preset(Preset::Tiny);
        config.warmup = WarmupConfig { learning_rate: 0.0, region_codes_from: 0.0, steps: 40, ..config.warmup };
        let (dataset, device, team) = (dataset(folder.path(), 9), Device::Cpu, Team::default());
        // Codes as long as the tiny preset's need more portraits than these.
        config.model.field.style_dim = 6;
        let inputs = Inputs { dataset, perceptual: None, start: None, device, team };
        let mut stage = Warmup::new(&config, &inputs, None).unwrap();
        let before = stage.generator.parameters().snapshot().unwrap();
        let first = stage.codes.as_tensor().copy().unwrap();
        for step in 0..3 {
            stage.step(step).unwrap();
        }
        let values = |tensor: &Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (name, weight) in stage.generator.parameters().snapshot().unwrap() {
            // α follows its schedule, not a gradient.
            assert!(name.ends_with("log_alpha") || values(&weight) == values(&before[&name]), "{name} moved");
        }
        assert_ne!(values(&first), values(stage.codes.as_tensor()));
        let offsets = stage.portrait_codes().unwrap().offsets.unwrap();
        assert!(values(&offsets).iter().any(|value| *value != 0.0));
    }

    #[test]
    fn every_groups_gradient_predicts_how_the_loss_falls() {
        let folder = tempfile::tempdir().unwrap();
        let stage = stage(folder.path());
        let loss = |_: ()| {
            let mut batch = stage.draw(3, 0.0).unwrap();
            stage.losses(&mut batch).unwrap().0
        };
        let value = |loss: &Tensor| f64::from(loss.to_scalar::<f32>().unwrap());
        let start = loss(());
        let gradients = start.backward().unwrap();
        let mut variables = stage.generator.parameters().variables();
        variables.push((CODES.into(), stage.codes.clone()));
        let mut checked = 0;
        for (name, variable) in variables {
            let Some(gradient) = gradients.get(&variable) else { continue };
            let square = f64::from(gradient.sqr().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap());
            let original = variable.as_tensor().copy().unwrap();
            // A step that changes the loss by about 2e-3, above f32 rounding, but no longer than curvature allows.
            let rate = (1e-3 / square).min(0.02 / square.sqrt());
            if rate * square < 2e-4 {
                continue;
            }
            let at = |sign: f64| {
                variable.set(&(&original + (gradient * (sign * rate)).unwrap()).unwrap()).unwrap();
                value(&loss(()))
            };
            let slope = (at(1.0) - at(-1.0)) / (2.0 * rate);
            variable.set(&original).unwrap();
            checked += 1;
            assert!((slope / square - 1.0).abs() < 0.05, "{name}: predicted {square}, found {slope}");
        }
        assert!(checked >= 8, "only {checked} weights had a gradient worth checking");
    }
}
