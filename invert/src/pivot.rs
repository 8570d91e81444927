//! The pivot: codes of all nine regions and the camera, found by descent on the picture they give.
//!
//! Coarse to fine: first coordinates that move all rows together, on rays of the field alone, then every row free, then
//! whole pictures at the output resolution. Codes live in whitened spaces ([`CodeSpace`]), held to the model's
//! distribution by their mean square and to one person by their distance from where all rows move together. Several
//! photos of one person share the codes; each has its own camera, and steps take them in turn. Half of the rays go where
//! the picture was off ([`Focus`]).

use candle_core::{Tensor, Var};
use cnerf_core::{
    camera::{CAMERA_PARAMETERS, Camera},
    config::UpsamplerStyle,
    model::{
        file::Tensors,
        generator::{Generator, Picture},
    },
    region::REGION_COUNT,
    render::RenderSettings,
    rng::Stream,
    train::optimiser::{Adam, Betas, Group, Schedule},
};

use crate::{
    checkpoint,
    config::{InvertConfig, PivotConfig, Steps},
    error::Result,
    events::StepReport,
    focus::Focus,
    objective::{self, Loss, PhotoWeights, Target},
    space::CodeSpace,
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x7069_766f;
/// What the render under a whole picture counts beside the picture itself.
const RENDER_SHARE: f64 = 0.5;
/// Whitened codes further out than this lie where the model has no portraits; a start is not trusted beyond.
const MOST_UNUSUAL: f64 = 3.0;
const BETAS: Betas = Betas { first: 0.9, second: 0.99 };
/// Rates fall over the second half of each phase.
const SCHEDULE: Schedule = Schedule { warmup_steps: 5, hold: 0.5, floor: 0.1 };

/// The running optimisation.
pub struct Pivot {
    config: PivotConfig,
    steps: Steps,
    seed: u64,
    space: CodeSpace,
    /// Coordinates, `[1, K]`.
    shared: Var,
    /// Whitened, `[18, D]`; row 2 i + j is aspect j of region i.
    rows: Var,
    /// Whitened global code of the upsampler, `[1, D]`, if it has one.
    global: Option<Var>,
    /// One a photo, `[1, 6]` each, see [`Camera::parameters`].
    cameras: Vec<Var>,
    first_cameras: Vec<Tensor>,
    /// Where each photo's picture is off.
    focus: Vec<Focus>,
    moves_camera: bool,
    optimiser: Adam,
    step: usize,
}

impl Pivot {
    /// Starts at the portrait of the noise `start` `[1, noise_dim]`, else at the model's mean portrait, seen by one of `cameras`
    /// in each photo.
    pub fn new(
        generator: &Generator,
        cameras: &[Camera],
        start: Option<&Tensor>,
        config: &InvertConfig,
    ) -> Result<Self> {
        let space = CodeSpace::measure(generator)?;
        let device = generator.device();
        let shared = match start {
            Some(noise) => {
                let codes = generator.codes_of(&noise.to_device(&device)?)?;
                space.coordinates(&codes)?.clamp(-MOST_UNUSUAL, MOST_UNUSUAL)?.detach()
            }
            None => Tensor::zeros((1, space.coordinate_count()), candle_core::DType::F32, &device)?,
        };
        let zeros = |rows: usize| Var::zeros((rows, space.style_dim()), candle_core::DType::F32, &device);
        let global = matches!(&generator.config().upsampler, Some(u) if u.style == UpsamplerStyle::Global);
        let first_cameras = cameras
            .iter()
            .map(|camera| Ok(Camera::parameter_tensor(&[*camera], &device)?))
            .collect::<Result<Vec<_>>>()?;
        let mut pivot = Self {
            config: config.pivot.clone(),
            steps: config.steps(),
            seed: config.seed,
            shared: Var::from_tensor(&shared)?,
            rows: zeros(2 * REGION_COUNT)?,
            global: if global { Some(zeros(1)?) } else { None },
            cameras: first_cameras.iter().map(Var::from_tensor).collect::<candle_core::Result<_>>()?,
            focus: first_cameras.iter().map(|_| Focus::new(generator.render_resolution())).collect(),
            first_cameras,
            moves_camera: !config.fixed_camera,
            optimiser: Adam::new(Vec::new(), BETAS),
            step: 0,
            space,
        };
        pivot.optimiser = pivot.optimiser_of(pivot.shared.clone());
        Ok(pivot)
    }

    /// Whether all steps are done.
    pub fn is_done(&self) -> bool {
        self.step >= self.steps.pivot()
    }

    /// Whether the step just done was the last of its phase.
    pub fn ended_phase(&self) -> bool {
        let Steps { shared, free, .. } = self.steps;
        [shared, shared + free, self.steps.pivot()].contains(&self.step)
    }

    /// Steps done.
    pub fn steps_done(&self) -> usize {
        self.step
    }

    /// Adds all that steps have changed to a checkpoint's tensors.
    pub(crate) fn save(&self, tensors: &mut Tensors) -> Result<()> {
        let values = self.variables().into_iter().map(|(name, value)| (name, value.as_tensor().clone()));
        checkpoint::put_all(tensors, "pivot", values);
        for (index, focus) in self.focus.iter().enumerate() {
            tensors.insert(format!("pivot.focus{index}"), focus.state()?);
        }
        Ok(self.optimiser.save("pivot.adam", tensors)?)
    }

    /// Goes back to where [`Self::save`] was called, after `step` steps.
    pub(crate) fn restore(&mut self, step: usize, tensors: &Tensors) -> Result<()> {
        for (name, variable) in self.variables() {
            variable.set(&checkpoint::take(tensors, &format!("pivot.{name}"), variable.dims())?)?;
        }
        for (index, focus) in self.focus.iter_mut().enumerate() {
            let shape = focus.state()?.dims().to_vec();
            focus.restore(&checkpoint::take(tensors, &format!("pivot.focus{index}"), &shape)?)?;
        }
        self.step = step.min(self.steps.pivot());
        // The rows are freed by the step after the shared phase's last.
        let moving = if self.step <= self.steps.shared { &self.shared } else { &self.rows };
        self.optimiser = self.optimiser_of(moving.clone());
        Ok(self.optimiser.load("pivot.adam", tensors)?)
    }

    fn variables(&self) -> Vec<(String, Var)> {
        let mut all = vec![("shared".to_owned(), self.shared.clone()), ("rows".to_owned(), self.rows.clone())];
        all.extend(self.global.iter().map(|code| ("global".to_owned(), code.clone())));
        all.extend(self.cameras.iter().enumerate().map(|(index, camera)| (format!("camera{index}"), camera.clone())));
        all
    }

    /// The codes as they are now, `[1, 9, 2, D]`, without a graph.
    pub fn codes(&self) -> Result<Tensor> {
        Ok(self.live_codes()?.detach())
    }

    /// The upsampler's global code as it is now, `[1, D]`.
    pub fn global(&self) -> Result<Option<Tensor>> {
        Ok(self.live_global()?.map(|code| code.detach()))
    }

    /// The space the codes were optimised in.
    pub fn space(&self) -> &CodeSpace {
        &self.space
    }

    /// The cameras as they are now, one a photo.
    pub fn cameras(&self) -> Result<Vec<Camera>> {
        let camera = |camera: &Var| {
            let values: Vec<f32> = camera.as_tensor().flatten_all()?.to_vec1()?;
            let mut parameters = [0.0; CAMERA_PARAMETERS];
            parameters.iter_mut().zip(&values).for_each(|(parameter, value)| *parameter = f64::from(*value));
            Ok(Camera::from_parameters(parameters))
        };
        self.cameras.iter().map(camera).collect()
    }

    /// One step, on the photo whose turn it is; `targets` are as many as there are cameras.
    pub fn step(&mut self, generator: &Generator, targets: &[Target]) -> Result<StepReport> {
        if self.step == self.steps.shared {
            self.rows.set(&self.space.whitened(&self.space.at(self.shared.as_tensor())?)?.detach())?;
            self.optimiser = self.optimiser_of(self.rows.clone());
        }
        let whole = self.step >= self.steps.shared + self.steps.free;
        let (index, target, camera) = self.turn(targets)?;
        let loss = if whole {
            self.whole_loss(generator, target, &camera)?
        } else {
            self.ray_loss(generator, index, target, &camera)?
        };
        let total = (loss.total.clone() + self.regularisation()?)?;
        let value = objective::scalar(&total)?;
        if !value.is_finite() {
            return Err(cnerf_core::Error::not_finite("the pivot's loss").into());
        }
        let (position, length) = self.position();
        self.optimiser.step(&total.backward()?, SCHEDULE.factor(position, length))?;
        self.step += 1;
        Ok(StepReport { step: self.step, total: self.steps.pivot(), loss: value, psnr: loss.psnr() })
    }

    /// The photo whose turn it is: its number, and its camera.
    fn turn<'a>(&self, targets: &'a [Target]) -> Result<(usize, &'a Target, Tensor)> {
        let index = self.step % self.cameras.len().max(1);
        match (targets.get(index), self.cameras.get(index)) {
            (Some(target), Some(camera)) => Ok((index, target, camera.as_tensor().clone())),
            _ => Err(cnerf_core::Error::shape("photos", [self.cameras.len()], &[targets.len()]).into()),
        }
    }

    /// The step within the phase of the present optimiser, and that phase's length.
    fn position(&self) -> (usize, usize) {
        match self.step.checked_sub(self.steps.shared) {
            Some(position) => (position, self.steps.free + self.steps.whole),
            None => (self.step, self.steps.shared),
        }
    }

    fn live_codes(&self) -> Result<Tensor> {
        if self.step < self.steps.shared {
            self.space.at(self.shared.as_tensor())
        } else {
            self.space.to_portrait(self.rows.as_tensor())
        }
    }

    fn live_global(&self) -> Result<Option<Tensor>> {
        self.global.as_ref().map(|code| self.space.to_global(code.as_tensor())).transpose()
    }

    fn ray_loss(&mut self, generator: &Generator, index: usize, target: &Target, camera: &Tensor) -> Result<Loss> {
        let mut random = Stream::new(self.seed, &[STREAM, self.step as u64]);
        let level = &target.render;
        let Some(focus) = self.focus.get(index) else {
            return Err(cnerf_core::Error::shape("photos", [self.focus.len()], &[index + 1]).into());
        };
        let pixels = focus.draw(self.steps.rays, self.config.focus, &mut random, &generator.device())?;
        let field = generator.field().portraits(&self.live_codes()?)?;
        let sampling = generator.render_settings().sampling;
        let output = objective::render_pixels(&field, camera, &pixels, level.resolution, &sampling, &mut random)?;
        let loss = objective::ray_loss(&output, level, &pixels, &self.weights())?;
        if let Some(focus) = self.focus.get_mut(index) {
            focus.saw(&pixels, &loss.error)?;
        }
        Ok(loss)
    }

    /// The loss of the whole picture seen by `camera`.
    pub(crate) fn whole_loss(&self, generator: &Generator, target: &Target, camera: &Tensor) -> Result<Loss> {
        let codes = self.live_codes()?;
        let picture = whole_picture(generator, &codes, self.live_global()?.as_ref(), camera, true)?;
        whole_loss(&picture, target, &self.weights())
    }

    fn weights(&self) -> PhotoWeights {
        let PivotConfig { absolute, squared, perceptual, masks, opacity, .. } = self.config;
        PhotoWeights { absolute, squared, perceptual, masks, opacity }
    }

    fn regularisation(&self) -> Result<Tensor> {
        let mut total = if self.step < self.steps.shared {
            (self.shared.as_tensor().sqr()?.mean_all()? * self.config.prior)?
        } else {
            let rows = self.rows.as_tensor();
            let together = self.space.at(&self.space.coordinates(&self.space.to_portrait(rows)?)?)?;
            let apart = (rows - self.space.whitened(&together)?)?.sqr()?.mean_all()?;
            ((rows.sqr()?.mean_all()? * self.config.prior)? + (apart * self.config.agreement)?)?
        };
        if let Some(global) = &self.global {
            total = (total + (global.as_tensor().sqr()?.mean_all()? * self.config.prior)?)?;
        }
        let [angle, shift, zoom] = self.config.camera_prior.map(|deviation| 1.0 / deviation.max(1e-6) as f32);
        let scale = Tensor::new(&[[angle, angle, angle, shift, shift, zoom]], self.rows.device())?;
        for (camera, first) in self.cameras.iter().zip(&self.first_cameras) {
            let moved = ((camera.as_tensor() - first)? * &scale)?;
            total = (total + (moved.sqr()?.sum_all()? * self.config.camera)?)?;
        }
        Ok(total)
    }

    fn optimiser_of(&self, codes: Var) -> Adam {
        let mut variables = vec![("codes".to_owned(), codes)];
        variables.extend(self.global.iter().map(|code| ("global".to_owned(), code.clone())));
        let group = |variables, learning_rate| Group { variables, learning_rate, largest_gradient_norm: None };
        let mut groups = vec![group(variables, self.config.code_rate)];
        if self.moves_camera {
            let named = |(index, camera): (usize, &Var)| (format!("camera{index}"), camera.clone());
            groups.push(group(self.cameras.iter().enumerate().map(named).collect(), self.config.camera_rate));
        }
        Adam::new(groups, BETAS)
    }
}

/// The finished picture of one portrait, with its graph if `differentiable`.
pub fn whole_picture(
    generator: &Generator,
    codes: &Tensor,
    global: Option<&Tensor>,
    camera: &Tensor,
    differentiable: bool,
) -> Result<Picture> {
    let settings = RenderSettings { differentiable, ..generator.render_settings() };
    let frame = generator.render(codes, camera, &settings)?;
    let lifted = generator.upsample(&frame, codes, global)?;
    let (rgb, masks) =
        if differentiable { (lifted.rgb, lifted.masks) } else { (lifted.rgb.detach(), lifted.masks.detach()) };
    Ok(Picture { rgb, masks, frame })
}

/// The losses of a whole picture and of the render under it.
pub fn whole_loss(picture: &Picture, target: &Target, weights: &PhotoWeights) -> Result<Loss> {
    let finished = objective::picture_loss(&picture.rgb, target, weights)?;
    let render = objective::frame_loss(&picture.frame, &target.render, weights)?;
    Ok(Loss { total: (finished.total.clone() + (render.total * RENDER_SHARE)?)?, ..finished })
}
