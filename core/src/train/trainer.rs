//! The trainer: runs the stages one after the other, one optimiser step a call, and keeps the run's folder.
//!
//! `RUN/config.toml` the resolved configuration · `log.jsonl` and TensorBoard's `events.*` a line every few steps ·
//! `samples/` grids · `checkpoints/` all that is needed to continue, the newest few and the best · `model.safetensors`
//! the result. Of processes that train together, the first keeps it.

use std::{
    fs::OpenOptions,
    io::Write as _,
    path::{Path, PathBuf},
    sync::Arc,
    time::Instant,
};

use candle_core::Device;
use image::RgbImage;

use crate::{
    data::dataset::Dataset,
    error::{Error, Result},
    eval::perceptual::Perceptual,
    files,
    interop::tensorboard::EventFile,
    model::{file::Tensors, generator::Generator},
    train::{
        checkpoint::{CheckpointHeader, Checkpoints},
        config::{Stage, TrainConfig},
        events::{Event, Metrics, StepReport},
        field_stage::FieldStage,
        portrait_codes::PortraitCodes,
        team::Team,
        upsampler_stage::UpsamplerStage,
        warmup::Warmup,
    },
};

/// One stage of training: knows its losses and its state, nothing of files.
pub trait StageRun {
    /// Does optimiser step number `step` (from 0) and says what was measured.
    fn step(&mut self, step: usize) -> Result<Metrics>;
    /// What a step's metrics say of the error that training is to bring down; none where losses do not tell, as those
    /// of adversaries.
    fn error(&self, _metrics: &Metrics) -> Option<f64> {
        None
    }
    /// Everything that changes from step to step.
    fn save(&self, tensors: &mut Tensors) -> Result<()>;
    /// Takes back what [`Self::save`] gave.
    fn load(&mut self, tensors: &Tensors) -> Result<()>;
    /// A grid of pictures that shows how far the stage is.
    fn samples(&self) -> Result<RgbImage>;
    /// The generator as it would be shipped now, and what the next stage starts from.
    fn finished(&self) -> Result<Start>;
}

/// What a stage starts from.
#[derive(Clone)]
pub struct Start {
    /// Its weights are copied, never changed.
    pub generator: Generator,
    /// The training portraits' own codes, if a warm-up gave them any.
    pub portrait_codes: Option<PortraitCodes>,
}

impl Start {
    /// The model file at `path` and, if a warm-up left the training portraits' codes beside it, those.
    pub fn open(path: &Path, device: &Device) -> Result<Self> {
        let generator = Generator::open(path, device)?;
        let path = path.with_file_name(CODES_FILE);
        let portrait_codes = if path.is_file() { Some(PortraitCodes::read(&path, device)?) } else { None };
        Ok(Self { generator, portrait_codes })
    }

    fn save_codes(&self, run: &Path) -> Result<()> {
        match &self.portrait_codes {
            Some(codes) => codes.write(&run.join(CODES_FILE)),
            None => Ok(()),
        }
    }
}

/// Where a run keeps the training portraits' codes.
const CODES_FILE: &str = "codes.safetensors";

/// What a run needs besides its configuration.
pub struct Inputs {
    /// Portraits, masks and cameras.
    pub dataset: Arc<Dataset>,
    /// Perceptual features for the losses that use them.
    pub perceptual: Option<Perceptual>,
    /// A model to start from instead of fresh weights.
    pub start: Option<Start>,
    /// Where to compute.
    pub device: Device,
    /// The processes that train together.
    pub team: Team,
}

/// Runs the stages of a configuration.
pub struct Trainer {
    config: TrainConfig,
    inputs: Inputs,
    run: PathBuf,
    stages: Vec<Stage>,
    checkpoints: Checkpoints,
    current: Option<Current>,
    finished: Option<Start>,
    last_checkpoint: Option<PathBuf>,
    /// Errors since the last checkpoint.
    errors: Vec<f64>,
    /// Opened at the first step: a run that cannot begin leaves none.
    tensorboard: Option<EventFile>,
}

struct Current {
    position: usize,
    step: usize,
    stage: Box<dyn StageRun>,
}

impl Trainer {
    /// A new run in the folder `run`, which must not hold one yet.
    pub fn new(config: TrainConfig, stage: Stage, inputs: Inputs, run: &Path) -> Result<Self> {
        if inputs.team.leads() && run.join("config.toml").exists() {
            return Err(Error::malformed(
                run,
                "holds a run already; pass --resume to continue it or choose another folder",
            ));
        }
        let trainer = Self::open(config, stage, inputs, run)?;
        trainer.save_config()?;
        Ok(trainer)
    }

    fn save_config(&self) -> Result<()> {
        if self.inputs.team.leads() {
            files::write_atomically(&self.run.join("config.toml"), self.config.to_toml()?.as_bytes())?;
        }
        Ok(())
    }

    /// Continues the run in the folder `run` from its newest checkpoint, or from its start if it has none.
    pub fn resume(config: TrainConfig, stage: Stage, inputs: Inputs, run: &Path) -> Result<Self> {
        let mut trainer = Self::open(config, stage, inputs, run)?;
        if let Some((path, header, tensors)) = trainer.checkpoints.newest()? {
            let position = trainer.stages.iter().position(|known| *known == header.stage).ok_or_else(|| {
                Error::malformed(
                    &path,
                    format!("was written by stage {:?}, which this run does not have", header.stage),
                )
            })?;
            if position > 0 {
                // The stages before are done: their result lies in the run's folder.
                let path = run.join("model.safetensors");
                trainer.finished = Some(Start::open(&path, &trainer.inputs.device)?);
            }
            let mut current = trainer.begin(position)?;
            current.stage.load(&tensors)?;
            current.step = header.step;
            trainer.current = Some(current);
            trainer.last_checkpoint = Some(path);
        }
        // Settings changed on resuming hold for the next resumption too.
        trainer.save_config()?;
        Ok(trainer)
    }

    fn open(config: TrainConfig, stage: Stage, inputs: Inputs, run: &Path) -> Result<Self> {
        config.validate()?;
        let stages = stages(&config, stage)?;
        let checkpoints = Checkpoints::of(run, config.keep_checkpoints);
        let (run, current, finished) = (run.to_owned(), None, None);
        Ok(Self {
            config,
            inputs,
            run,
            stages,
            checkpoints,
            current,
            finished,
            last_checkpoint: None,
            errors: Vec::new(),
            tensorboard: None,
        })
    }

    /// The resolved configuration.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// Does one optimiser step; `None` when the run is done. An error leaves the last checkpoint as it was.
    pub fn step(&mut self) -> Result<Option<Vec<Event>>> {
        let mut events = Vec::new();
        let mut current = match self.current.take() {
            Some(current) => current,
            None if self.finished.is_some() => return Ok(None),
            None => self.begin(0)?,
        };
        let stage = self.stages[current.position];
        let total = steps(&self.config, stage);
        let began = Instant::now();
        let metrics = current.stage.step(current.step).map_err(|error| self.explain(error))?;
        if let Some(quantity) = metrics.first_not_finite() {
            return Err(self.explain(Error::not_finite(quantity)));
        }
        if current.step == 0 {
            events.push(Event::Stage { stage, step: 0, total });
        }
        current.step += 1;
        let step = current.step;
        self.errors.extend(current.stage.error(&metrics));
        let before = self.steps_before(current.position);
        let report = StepReport { stage, step, total, seconds: began.elapsed().as_secs_f64(), metrics };
        let leads = self.inputs.team.leads();
        if leads && (step % self.config.log_steps == 0 || step == 1 || step == total) {
            self.log(&report)?;
            events.extend(self.tell_tensorboard(step, |file| file.scalars(before + step, report.scalars())));
        }
        events.push(Event::Step(report));
        if leads && (step % self.config.sample_steps == 0 || step == total) {
            events.extend(self.write_samples(&current, stage));
        }
        if step % self.config.checkpoint_steps == 0 || step == total {
            events.extend(self.write_checkpoint(&current)?.map(Event::Checkpoint));
        }
        if step < total {
            self.current = Some(current);
        } else {
            events.extend(self.advance(current)?);
        }
        Ok(Some(events))
    }

    /// Writes a checkpoint now, e.g. because the user wants to stop; of a team, the leading process does.
    pub fn checkpoint(&mut self) -> Result<Option<PathBuf>> {
        let Some(current) = self.current.take() else { return Ok(None) };
        let path = self.write_checkpoint(&current);
        self.current = Some(current);
        path
    }

    /// Ends a stage: the next one begins from its result, or the model is written.
    fn advance(&mut self, current: Current) -> Result<Vec<Event>> {
        let finished = current.stage.finished()?;
        let path = self.run.join("model.safetensors");
        if self.inputs.team.leads() {
            finished.save_codes(&self.run)?;
            finished.generator.save(
                &path,
                &format!("{:?}", self.config.preset).to_lowercase(),
                &self.provenance(current.position),
            )?;
        }
        let events = vec![Event::Model(path)];
        self.finished = Some(finished);
        if current.position + 1 < self.stages.len() {
            self.current = Some(self.begin(current.position + 1)?);
        }
        Ok(events)
    }

    fn begin(&mut self, position: usize) -> Result<Current> {
        let start = self.finished.take().or_else(|| self.inputs.start.clone());
        let stage = begin(self.stages[position], &self.config, &self.inputs, start.as_ref())?;
        Ok(Current { position, step: 0, stage })
    }

    fn provenance(&self, position: usize) -> String {
        let stages: Vec<String> = self.stages[..=position]
            .iter()
            .map(|stage| format!("{} {} steps", format!("{stage:?}").to_lowercase(), steps(&self.config, *stage)))
            .collect();
        let own = format!(
            "trained by cnerf {}: {}; {} portraits; seed {}",
            env!("CARGO_PKG_VERSION"),
            stages.join(", "),
            self.inputs.dataset.len(),
            self.config.seed
        );
        match self.inputs.start.as_ref().and_then(|start| start.generator.header()) {
            Some(start) => format!("{}; then {own}", start.provenance),
            None => own,
        }
    }

    /// Steps of the stages before the one at `position`.
    fn steps_before(&self, position: usize) -> usize {
        self.stages[..position].iter().map(|stage| steps(&self.config, *stage)).sum()
    }

    fn write_checkpoint(&mut self, current: &Current) -> Result<Option<PathBuf>> {
        let errors = std::mem::take(&mut self.errors);
        if !self.inputs.team.leads() {
            return Ok(None);
        }
        let before = self.steps_before(current.position);
        let error = (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64);
        let header = CheckpointHeader { stage: self.stages[current.position], step: current.step, error };
        let mut tensors = Tensors::new();
        current.stage.save(&mut tensors)?;
        let path = self.checkpoints.write(before + current.step, &header, &tensors)?;
        self.last_checkpoint = Some(path.clone());
        Ok(Some(path))
    }

    /// A failed preview must not end hours of training.
    fn write_samples(&mut self, current: &Current, stage: Stage) -> Vec<Event> {
        let name = format!("{}-{:06}.png", format!("{stage:?}").to_lowercase(), current.step);
        let path = self.run.join("samples").join(name);
        let written = current.stage.samples().and_then(|picture| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            picture.write_to(&mut bytes, image::ImageFormat::Png).map_err(|error| Error::malformed(&path, error))?;
            files::write_atomically(&path, bytes.get_ref())?;
            Ok((picture.dimensions(), bytes.into_inner()))
        });
        match written {
            Ok(((width, height), png)) => {
                let step = self.steps_before(current.position) + current.step;
                let failed =
                    self.tell_tensorboard(current.step, |file| file.png(step, "samples", [width, height], &png));
                [Event::Samples(path)].into_iter().chain(failed).collect()
            }
            Err(error) => vec![Event::Warning(format!("no sample grid at step {}: {error}", current.step))],
        }
    }

    /// Curves and pictures for TensorBoard; training goes on without them.
    fn tell_tensorboard(&mut self, step: usize, tell: impl FnOnce(&mut EventFile) -> Result<()>) -> Option<Event> {
        let told = match self.tensorboard.take().map_or_else(|| EventFile::create(&self.run), Ok) {
            Ok(mut file) => tell(&mut file).map(|()| self.tensorboard = Some(file)),
            Err(error) => Err(error),
        };
        told.err().map(|error| Event::Warning(format!("nothing for TensorBoard at step {step}: {error}")))
    }

    fn log(&self, report: &StepReport) -> Result<()> {
        let path = self.run.join("log.jsonl");
        let failed = |error| Error::io(&path, error);
        std::fs::create_dir_all(&self.run).map_err(failed)?;
        let line = serde_json::to_string(report).map_err(|error| Error::malformed(&path, error))?;
        let mut log = OpenOptions::new().create(true).append(true).open(&path).map_err(failed)?;
        writeln!(log, "{line}").map_err(failed)
    }

    /// Says, for a number that is not finite, where the run can be picked up.
    fn explain(&self, error: Error) -> Error {
        match error {
            Error::NotFinite { quantity, context: None } => {
                let context = match &self.last_checkpoint {
                    Some(path) => {
                        format!("the last good checkpoint is {}; resume with a lower learning rate", path.display())
                    }
                    None => "no checkpoint was written yet; start again with a lower learning rate".into(),
                };
                Error::NotFinite { quantity, context: Some(context) }
            }
            other => other,
        }
    }
}

/// A stage before its first step.
pub(super) fn begin(
    stage: Stage,
    config: &TrainConfig,
    inputs: &Inputs,
    start: Option<&Start>,
) -> Result<Box<dyn StageRun>> {
    Ok(match stage {
        Stage::Warmup => Box::new(Warmup::new(config, inputs, start)?),
        Stage::Field => Box::new(FieldStage::new(config, inputs, start)?),
        Stage::Upsampler | Stage::All => Box::new(UpsamplerStage::new(config, inputs, start)?),
    })
}

/// The stages a run consists of; `all` takes those that the configuration gives steps.
pub(super) fn stages(config: &TrainConfig, stage: Stage) -> Result<Vec<Stage>> {
    let stages = match stage {
        Stage::All => [Stage::Warmup, Stage::Field, Stage::Upsampler]
            .into_iter()
            .filter(|stage| steps(config, *stage) > 0)
            .collect(),
        single => vec![single],
    };
    match stages.iter().find(|stage| steps(config, **stage) == 0) {
        Some(stage) => {
            let name = format!("{stage:?}").to_lowercase();
            Err(Error::config(
                format!("{name}.steps"),
                format!("this preset gives stage {name} no steps; pass --set {name}.steps=N or --kimg"),
            ))
        }
        None if stages.is_empty() => Err(Error::config("--stage", "no stage has any steps")),
        None => Ok(stages),
    }
}

/// Steps the configuration gives a stage.
pub fn steps(config: &TrainConfig, stage: Stage) -> usize {
    match stage {
        Stage::Warmup => config.warmup.steps,
        Stage::Field => config.field.steps,
        Stage::Upsampler => config.upsampler.steps,
        Stage::All => config.warmup.steps + config.field.steps + config.upsampler.steps,
    }
}
