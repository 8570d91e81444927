//! The inverter: one optimiser step a call, from a subject to its portrait.

use std::{
    collections::{BTreeMap, VecDeque},
    path::Path,
    time::Instant,
};

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    eval::quality::{self, Agreement},
    model::{
        file::{self, Tensors},
        generator::{Generator, Picture},
    },
    render::{
        RadianceField as _,
        plan::{FrameReport, Planned, Session},
    },
};
use image::{Luma, RgbImage};

use crate::{
    checkpoint::{self, CheckpointHeader},
    config::{Effort, InvertConfig},
    error::{Error, Result},
    events::Event,
    likeness::Likeness,
    objective::Target,
    photo::Subject,
    pivot::{Pivot, whole_picture},
    portrait::{Deltas, Metrics, ModelName, Portrait},
    tune::{Frozen, Tune},
};

/// Width and height of a portrait file's thumbnail, pixels.
const THUMBNAIL: u32 = 96;
/// How far the novel views of [`Panels`] are turned, radians.
const NOVEL_VIEW_RAD: f64 = 0.4;
/// Depth along the view axis shown as white and as black, world units.
const DEPTH_SHOWN: [f64; 2] = [0.92, 1.08];

/// The weight that moves a region's colour and nothing else.
const COLOUR_BIAS: &str = "field.colour.bias";

/// An inversion under way.
pub struct Inverter<'a> {
    generator: &'a Generator,
    likeness: Option<&'a Likeness>,
    config: InvertConfig,
    model: ModelName,
    subjects: Vec<Subject>,
    targets: Vec<Target>,
    pivot: Pivot,
    tune: Option<Tune>,
    settled: bool,
    pending: VecDeque<Event>,
    seconds: f64,
}

/// A finished inversion.
pub struct Inversion {
    /// The portrait, to be saved.
    pub portrait: Portrait,
    /// Pictures of it, to be looked at.
    pub panels: Panels,
}

/// Pictures of an inversion at the model's output resolution.
pub struct Panels {
    /// The aligned photo.
    pub photo: RgbImage,
    /// The pivot: the untuned model at the codes found.
    pub pivot: RgbImage,
    /// The portrait as it is in the file.
    pub tuned: RgbImage,
    /// Its regions.
    pub regions: RgbImage,
    /// Its depth, near is bright.
    pub depth: RgbImage,
    /// Seen from both sides.
    pub novel: [RgbImage; 2],
}

impl<'a> Inverter<'a> {
    /// Prepares the inversion of `subject`. `model_name` is what the user calls the model. `likeness` adds a
    /// perceptual loss, and the LPIPS metric if it is that.
    pub fn new(
        generator: &'a Generator,
        model_name: &str,
        subject: Subject,
        config: InvertConfig,
        likeness: Option<&'a Likeness>,
    ) -> Result<Self> {
        Self::of_person(generator, model_name, vec![subject], config, likeness)
    }

    /// Prepares the inversion of several photos of one person: they will share codes and weights, each has its own
    /// camera, and steps take them in turn. Otherwise as [`Self::new`].
    pub fn of_person(
        generator: &'a Generator,
        model_name: &str,
        subjects: Vec<Subject>,
        config: InvertConfig,
        likeness: Option<&'a Likeness>,
    ) -> Result<Self> {
        let started = Instant::now();
        config.validate()?;
        if subjects.is_empty() {
            return Err(Error::config("photos", "at least one is needed"));
        }
        let target =
            |subject: &Subject| Target::new(&subject.aligned.picture, subject.labels.as_ref(), generator, likeness);
        let targets = subjects.iter().map(target).collect::<Result<_>>()?;
        let cameras: Vec<Camera> = subjects.iter().map(|subject| subject.aligned.camera).collect();
        let starts: Vec<&Tensor> = subjects.iter().filter_map(|subject| subject.start.as_ref()).collect();
        let start = if starts.is_empty() { None } else { Some(Tensor::cat(&starts, 0)?.mean_keepdim(0)?) };
        let pivot = Pivot::new(generator, &cameras, start.as_ref(), &config)?;
        let pending =
            subjects.iter().flat_map(|subject| subject.warnings.iter().cloned().map(Event::Warning)).collect();
        let model = ModelName { name: model_name.to_owned(), hash: generator.hash()? };
        let seconds = started.elapsed().as_secs_f64();
        let (tune, settled) = (None, false);
        Ok(Self { generator, likeness, config, model, subjects, targets, pivot, tune, settled, pending, seconds })
    }

    /// Writes all that the steps so far have changed to `path`, under a temporary name first.
    pub fn save(&self, path: &Path) -> Result<()> {
        let mut tensors = Tensors::new();
        self.pivot.save(&mut tensors)?;
        let header = CheckpointHeader {
            fingerprint: self.fingerprint()?,
            pivot_steps: self.pivot.steps_done(),
            tune: self.tune.as_ref().map(|tune| tune.save(&mut tensors)).transpose()?,
            seconds: self.seconds,
        };
        checkpoint::write(path, &header, &tensors)
    }

    /// Goes on from what [`Self::save`] wrote: from here on everything is, bit by bit, as if it had never stopped.
    ///
    /// # Errors
    /// If the file cannot be read, or was written for other photos, another model or another configuration.
    pub fn resume(&mut self, path: &Path) -> Result<()> {
        let (header, tensors) = checkpoint::read(path)?;
        if header.fingerprint != self.fingerprint()? {
            let reason = "belongs to another photo, model or setting; repeat the command it was stopped in, or remove \
                          it to begin anew";
            return Err(Error::malformed(path, reason));
        }
        let damaged = |error: Error| Error::malformed(path, format!("{error}; remove it to begin anew"));
        self.pivot.restore(header.pivot_steps, &tensors).map_err(damaged)?;
        if let Some(state) = &header.tune {
            let mut tune = Tune::new(self.generator, self.frozen()?, &self.config)?;
            tune.restore(state, &tensors).map_err(damaged)?;
            self.tune = Some(tune);
        }
        self.seconds += header.seconds;
        Ok(())
    }

    /// Whether the step just done is a good one to [`Self::save`] after: it ended a phase.
    pub fn ended_phase(&self) -> bool {
        self.tune.is_none() && self.pivot.ended_phase()
    }

    /// Steps done, and those there are at most.
    pub fn progress(&self) -> (usize, usize) {
        let steps = self.config.steps();
        let done = self.pivot.steps_done() + self.tune.as_ref().map_or(0, Tune::steps_done);
        (done, steps.pivot() + steps.tune)
    }

    /// What the outcome is a function of, as one hash.
    fn fingerprint(&self) -> Result<String> {
        let config = serde_json::to_vec(&self.config).map_err(|error| Error::config("settings", error))?;
        let likeness = self.likeness.map_or("none", Likeness::name);
        let named = format!("{} {likeness}", self.model.hash);
        let bytes = |bytes: &[u8]| Tensor::from_slice(bytes, bytes.len(), &Device::Cpu);
        let mut all =
            Tensors::from([("config".to_owned(), bytes(&config)?), ("model".to_owned(), bytes(named.as_bytes())?)]);
        for (index, (subject, target)) in self.subjects.iter().zip(&self.targets).enumerate() {
            let camera = Camera::parameter_tensor(&[subject.aligned.camera], &Device::Cpu)?;
            all.insert(format!("camera{index}"), camera.to_dtype(DType::F32)?);
            all.insert(format!("photo{index}"), target.output.colour.clone());
            all.extend(subject.start.iter().map(|start| (format!("start{index}"), start.clone())));
            all.extend(target.output.masks.iter().map(|masks| (format!("masks{index}"), masks.clone())));
        }
        Ok(file::hash(&all)?)
    }

    fn frozen(&self) -> Result<Frozen> {
        Ok(Frozen { codes: self.pivot.codes()?, global: self.pivot.global()?, cameras: self.pivot.cameras()? })
    }

    /// Does one step and says what happened; `None` when nothing is left to do.
    pub fn step(&mut self) -> Result<Option<Event>> {
        if let Some(event) = self.pending.pop_front() {
            return Ok(Some(event));
        }
        let started = Instant::now();
        let event = self.advance();
        self.seconds += started.elapsed().as_secs_f64();
        event
    }

    fn advance(&mut self) -> Result<Option<Event>> {
        if !self.pivot.is_done() {
            return Ok(Some(Event::Pivot(self.pivot.step(self.generator, &self.targets)?)));
        }
        if self.tune.is_none() {
            self.tune = Some(Tune::new(self.generator, self.frozen()?, &self.config)?);
        }
        let Some(tune) = &mut self.tune else { return Ok(None) };
        if self.settled || tune.is_done() {
            return Ok(None);
        }
        if tune.is_settled() {
            self.settled = true;
            return Ok(Some(Event::Settled { step: tune.steps_done() }));
        }
        Ok(Some(Event::Tune(tune.step(self.generator, self.pivot.space(), &self.targets)?)))
    }

    /// The portrait as it stands (the first photo's); usually after [`Self::step`] has returned `None`.
    pub fn finish(self) -> Result<Inversion> {
        let first = self.finish_all()?.into_iter().next();
        first.ok_or_else(|| Error::config("photos", "at least one is needed"))
    }

    /// The portraits of all photos as they stand, in order.
    pub fn finish_all(mut self) -> Result<Vec<Inversion>> {
        let started = Instant::now();
        let tuned = match &mut self.tune {
            Some(tune) => {
                let weights = tune.best_weights(&self.targets)?;
                Deltas::between(&self.generator.parameters().snapshot()?, &weights)?
            }
            None => Deltas::default(),
        };
        let whole = Whole {
            codes: self.pivot.codes()?,
            global: self.pivot.global()?,
            // Everything shown and measured is what the file gives back, rounding included.
            generator: tuned.generator(self.generator)?,
            deltas: tuned,
        };
        let depth_drift = self.tune.as_ref().map_or(Ok(0.0), |tune| tune.depth_drift(&whole.generator))?;
        let photos = self.subjects.iter().zip(&self.targets).zip(self.pivot.cameras()?);
        let mut inversions = photos
            .map(|((subject, target), camera)| self.finish_one(subject, target, camera, &whole, depth_drift))
            .collect::<Result<Vec<_>>>()?;
        let seconds = self.seconds + started.elapsed().as_secs_f64();
        inversions.iter_mut().for_each(|inversion| inversion.portrait.metrics.seconds = seconds);
        Ok(inversions)
    }

    fn finish_one(
        &self,
        subject: &Subject,
        target: &Target,
        camera: Camera,
        whole: &Whole,
        depth_drift: f64,
    ) -> Result<Inversion> {
        let Whole { codes, global, generator: tuned, deltas } = whole;
        let view = |camera: Camera| Camera::parameter_tensor(&[camera], &self.generator.device());
        let show = |generator: &Generator, view: &Tensor| whole_picture(generator, codes, global.as_ref(), view, false);
        let pivot_picture = show(self.generator, &view(camera)?)?;
        let picture = show(tuned, &view(camera)?)?;
        let side = |turn: f64| -> Result<RgbImage> {
            let turned = Camera { azimuth_rad: camera.azimuth_rad + turn, ..camera };
            one_picture(&show(tuned, &view(turned)?)?.rgb)
        };
        let tuned_rgb = one_picture(&picture.rgb)?;
        let panels = Panels {
            photo: one_picture(&target.output.colour)?,
            pivot: one_picture(&pivot_picture.rgb)?,
            regions: LabelMap::from_masks(&picture.masks.squeeze(0)?)?.colours(),
            depth: depth_picture(&picture, tuned_rgb.width())?,
            novel: [side(-NOVEL_VIEW_RAD)?, side(NOVEL_VIEW_RAD)?],
            tuned: tuned_rgb,
        };
        let metrics = Metrics {
            pivot_psnr: psnr(&pivot_picture.rgb, &target.output.colour)?,
            depth_drift,
            steps_pivot: self.config.steps().pivot(),
            steps_tune: self.tune.as_ref().map_or(0, Tune::steps_done),
            ..self.measure(&picture, target)?
        };
        let portrait = Portrait {
            model: self.model.clone(),
            source: subject.source.clone(),
            crop: Some(subject.aligned.transform),
            codes: codes.squeeze(0)?,
            upsampler_code: global.as_ref().map(|code| code.squeeze(0)).transpose()?,
            tint: None,
            camera,
            deltas: deltas.clone(),
            noise: Vec::new(),
            thumbnail: picture::resize(&panels.tuned, THUMBNAIL, THUMBNAIL)?,
            config: self.config.clone(),
            metrics,
            history: Vec::new(),
        };
        Ok(Inversion { portrait, panels })
    }

    fn measure(&self, picture: &Picture, target: &Target) -> Result<Metrics> {
        let photo = &target.output.colour;
        let rgb = picture.rgb.clamp(-1.0, 1.0)?;
        let lpips = self.likeness.map_or(Ok(None), |likeness| likeness.lpips(&rgb, photo))?;
        let mask_miou = match &target.output.masks {
            Some(known) => {
                let mut agreement = Agreement::default();
                agreement.add(
                    &LabelMap::from_masks(&known.squeeze(0)?)?,
                    &LabelMap::from_masks(&picture.masks.squeeze(0)?)?,
                )?;
                agreement.mean_iou()
            }
            None => None,
        };
        let ms_ssim = quality::ms_ssim(&rgb, photo)?.values.first().copied().unwrap_or(0.0);
        Ok(Metrics { psnr: psnr(&rgb, photo)?, ms_ssim, lpips, mask_miou, ..Metrics::default() })
    }
}

/// What all photos of a person share.
struct Whole {
    /// `[1, 9, 2, D]`.
    codes: Tensor,
    /// `[1, L]`.
    global: Option<Tensor>,
    /// With the tuned weights.
    generator: Generator,
    deltas: Deltas,
}

/// The tuned generator of a portrait, and its codes and camera as tensors: all that rendering it needs.
#[derive(Clone)]
pub struct Opened {
    /// The model with the portrait's weights.
    pub generator: Generator,
    /// `[1, 9, 2, D]`.
    pub codes: Tensor,
    /// `[1, L]`.
    pub global: Option<Tensor>,
    /// The camera that saw the photo.
    pub camera: Camera,
    /// The bias of every region's colour head before a tint is added, `[9, 3]`.
    pub(crate) untinted: Tensor,
}

impl Opened {
    /// Opens `portrait`, read from `path`, with the model it was made with.
    pub fn new(portrait: &Portrait, path: &Path, model: &Generator) -> Result<Self> {
        portrait.check_model(path, &model.hash()?)?;
        let device = model.device();
        let codes = portrait.codes.unsqueeze(0)?.to_device(&device)?;
        model.field().film(&codes)?; // Refuses codes of another length before anything is rendered.
        let global = portrait.upsampler_code.as_ref().map(|code| code.unsqueeze(0)?.to_device(&device)).transpose()?;
        let generator = portrait.deltas.generator(model)?;
        let biases = generator.parameters().snapshot()?.remove(COLOUR_BIAS);
        let untinted = biases.ok_or_else(|| cnerf_core::Error::shape(COLOUR_BIAS, "[9, 3]", &[]))?;
        let opened = Self { generator, codes, global, camera: portrait.camera, untinted };
        if let Some(tint) = &portrait.tint {
            opened.set_tint(tint)?;
        }
        Ok(opened)
    }

    /// Adds `tint` `[9, 3]` to the regions' colours, in place of the tint they have. Clones share their generator.
    pub(crate) fn set_tint(&self, tint: &Tensor) -> Result<()> {
        let tint = tint.to_device(self.untinted.device())?.to_dtype(self.untinted.dtype())?;
        let tinted = BTreeMap::from([(COLOUR_BIAS.to_owned(), (&self.untinted + tint)?)]);
        Ok(self.generator.parameters().restore(&tinted)?)
    }

    /// The portrait's finished picture from `camera`.
    pub fn picture(&self, camera: &Camera) -> Result<Picture> {
        let view = Camera::parameter_tensor(&[*camera], &self.generator.device())?;
        whole_picture(&self.generator, &self.codes, self.global.as_ref(), &view, false)
    }

    /// A session of the view from `camera`, to render edits in.
    pub(crate) fn session(&self, camera: &Camera) -> Result<Session> {
        let view = Camera::parameter_tensor(&[*camera], &self.generator.device())?;
        Ok(Session::new(&view, &self.generator.render_settings())?)
    }

    /// The finished picture of the session's view, as [`Self::picture`]: only what changed since the session's last one is
    /// evaluated. And how much that was.
    pub(crate) fn picture_in(&self, session: &mut Session) -> Result<(Picture, FrameReport)> {
        let field = self.generator.field().portraits(&self.codes)?.detached();
        let Planned { frame, report } = session.render(&field)?;
        let lifted = self.generator.upsample(&frame, &self.codes, self.global.as_ref())?;
        Ok((Picture { rgb: lifted.rgb.detach(), masks: lifted.masks.detach(), frame }, report))
    }
}

/// About how many seconds a photo will take with this configuration, on this machine: one step of each kind, timed on
/// a grey picture. At fast effort a step on the whole picture would be a tenth of the work: it is guessed from the rays.
pub fn estimate_seconds(generator: &Generator, config: &InvertConfig, likeness: Option<&Likeness>) -> Result<f64> {
    /// A step of tuning against a step of the pivot on whole pictures: depth and locality come on top.
    const TUNE_SHARE: f64 = 1.3;
    /// A ray of a whole picture against one alone: features, normals and the upsampler come on top.
    const WHOLE_SHARE: f64 = 1.4;
    let began = Instant::now();
    let side = generator.output_resolution() as u32;
    let grey = RgbImage::from_pixel(side, side, image::Rgb([128; 3]));
    let target = Target::new(&grey, None, generator, likeness)?;
    let steps = config.steps();
    // A pivot of two steps takes them on rays, with as many rays as the effort has.
    let short = InvertConfig { pivot_steps: Some(2), ..config.clone() };
    let mut pivot = Pivot::new(generator, &[Camera::default()], None, &short)?;
    let prepared = began.elapsed();
    let on_rays = warm_seconds(|| pivot.step(generator, std::slice::from_ref(&target)).map(drop))?;
    let whole = if config.effort == Effort::Fast {
        let rays = target.render.resolution * target.render.resolution;
        WHOLE_SHARE * on_rays * rays as f64 / steps.rays.max(1) as f64
    } else {
        let view = Camera::parameter_tensor(&[Camera::default()], &generator.device())?;
        warm_seconds(|| {
            pivot.whole_loss(generator, &target, &view)?.total.backward()?;
            Ok(())
        })?
    };
    let steps_on_rays = (steps.shared + steps.free) as f64;
    // What was done here is done again: the space of codes, the target's features.
    let rest = prepared.as_secs_f64();
    Ok(rest + on_rays * steps_on_rays + whole * (steps.whole as f64 + TUNE_SHARE * steps.tune as f64))
}

/// Seconds of the second of two runs: the first also takes memory from the system and wakes threads, several times over.
fn warm_seconds(mut step: impl FnMut() -> Result<()>) -> Result<f64> {
    step()?;
    let started = Instant::now();
    step()?;
    Ok(started.elapsed().as_secs_f64())
}

fn psnr(found: &Tensor, photo: &Tensor) -> Result<f64> {
    Ok(quality::psnr(&found.clamp(-1.0, 1.0)?, photo)?.first().copied().unwrap_or(0.0))
}

pub(crate) fn one_picture(rgb: &Tensor) -> Result<RgbImage> {
    let pictures = picture::from_tensor(rgb)?;
    Ok(pictures.into_iter().next().ok_or_else(|| cnerf_core::Error::shape("picture", "[1, 3, H, W]", rgb.dims()))?)
}

/// Depth in grey, near is bright, enlarged to `side` x `side` pixels.
fn depth_picture(picture: &Picture, side: u32) -> Result<RgbImage> {
    let [near, far] = DEPTH_SHOWN;
    let depth: Vec<Vec<f32>> = picture.frame.depth.squeeze(0)?.squeeze(0)?.to_vec2()?;
    let resolution = depth.len() as u32;
    let grey = image::GrayImage::from_fn(resolution, resolution, |x, y| {
        let value = depth.get(y as usize).and_then(|row| row.get(x as usize)).copied().map_or(far, f64::from);
        Luma([(255.0 * ((far - value) / (far - near)).clamp(0.0, 1.0)) as u8])
    });
    let grey = image::DynamicImage::ImageLuma8(grey).into_rgb8();
    Ok(image::imageops::resize(&grey, side, side, image::imageops::FilterType::Triangle))
}

#[cfg(test)]
pub(crate) mod tests;
