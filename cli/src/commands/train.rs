//! `cnerf train`: listens to a trainer and draws its progress.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use anyhow::{Context as _, bail};
use clap::{Args, ValueEnum as _};
use cnerf_core::{
    data::dataset::Dataset,
    eval::perceptual::Perceptual,
    model::generator::Generator,
    parameters::Parameters,
    train::{
        config::{Preset, Stage, TrainConfig},
        estimate::{Estimate, estimate},
        events::Event,
        team::Team,
        trainer::{Inputs, Start, Trainer, steps},
    },
};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    interrupt::Interrupt,
    options::ModelSource,
};

/// Arguments of `cnerf train`.
#[derive(Args, Debug)]
pub struct TrainArguments {
    /// Dataset: a folder or a zip (`cnerf dataset check` says whether it is sound)
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Folder of the run
    #[arg(long, value_name = "RUN")]
    out: PathBuf,
    /// Settings to start from
    #[arg(long, value_enum, default_value_t = Preset::Portrait)]
    preset: Preset,
    /// What to train
    #[arg(long, value_enum, default_value_t = Stage::All)]
    stage: Stage,
    /// Thousands of portraits to show in each stage, in place of the preset's steps
    #[arg(long, value_name = "N")]
    kimg: Option<f64>,
    /// Portraits a step, in place of the preset's
    #[arg(long, value_name = "N")]
    batch: Option<usize>,
    /// Continue the run in --out
    #[arg(long)]
    resume: bool,
    /// Print the resolved configuration, sizes, and the time and memory it will take by a few steps done here, and stop
    #[arg(long)]
    dry_run: bool,
    /// Change one setting, e.g. warmup.steps=500; may repeat
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// LPIPS weights (AlexNet or VGG16, safetensors) for the perceptual losses
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    /// Start from --model instead of fresh weights
    #[command(flatten)]
    model: ModelSource,
}

#[derive(Serialize)]
struct Report {
    run: PathBuf,
    model: Option<PathBuf>,
    steps: usize,
    seconds: f64,
    metrics: serde_json::Value,
    interrupted: bool,
}

#[derive(Serialize)]
struct DryRun {
    config: TrainConfig,
    portraits: usize,
    generator_parameters: usize,
    steps: usize,
    estimates: Vec<Estimate>,
    /// Stages without an estimate, and why.
    not_estimated: Vec<String>,
}

impl TrainArguments {
    /// Trains until done or interrupted.
    pub fn run(self, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        let team = team()?;
        let outcome =
            if team.leads() { self.run_in(&team, seed, console) } else { self.run_in(&team, seed, &Console::mute()) }?;
        team.finish();
        Ok(outcome)
    }

    fn run_in(&self, team: &Team, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        let config = self.resolve(seed)?;
        let dataset = Arc::new(Dataset::open(&self.data)?);
        let device = self.model.device()?;
        let perceptual = self.lpips.as_ref().map(|path| Perceptual::load(path, &device)).transpose()?;
        let start = self.model.model.as_ref().map(|name| self.start(name, &device)).transpose()?;
        let inputs = Inputs { dataset, perceptual, start, device, team: team.clone() };
        if self.dry_run {
            return self.dry_run(&config, &inputs, console);
        }
        let trainer = if self.resume {
            Trainer::resume(config, self.stage, inputs, &self.out)?
        } else {
            Trainer::new(config, self.stage, inputs, &self.out)?
        };
        self.listen(trainer, team, console)
    }

    /// A run's model with its portraits' codes, or a built-in model without.
    fn start(&self, name: &str, device: &candle_core::Device) -> anyhow::Result<Start> {
        match cnerf_models::bytes(name) {
            Some(_) => Ok(Start { generator: self.model.load_or(name)?, portrait_codes: None }),
            None => Ok(Start::open(Path::new(name), device)?),
        }
    }

    /// The configuration: the run's own when resuming, else the preset's; then --kimg, --batch and --set.
    fn resolve(&self, seed: Option<u64>) -> anyhow::Result<TrainConfig> {
        let mut config = if self.resume {
            let path = self.out.join("config.toml");
            let text = std::fs::read_to_string(&path).with_context(|| {
                format!("{}: no run to resume here; leave --resume out to start one", path.display())
            })?;
            TrainConfig::from_toml(&text).with_context(|| path.display().to_string())?
        } else {
            TrainConfig::preset(self.preset)
        };
        config.seed = seed.unwrap_or(config.seed);
        if let Some(batch) = self.batch {
            (config.warmup.batch, config.field.batch, config.upsampler.batch) = (batch, batch, batch);
        }
        if let Some(thousands) = self.kimg {
            if !(thousands > 0.0 && thousands <= 1e9) {
                bail!("--kimg {thousands}: must be a positive number");
            }
            let steps = |batch: usize| ((thousands * 1000.0 / batch.max(1) as f64).ceil() as usize).max(1);
            config.warmup.steps = steps(config.warmup.batch);
            config.field.steps = steps(config.field.batch);
            config.upsampler.steps = steps(config.upsampler.batch);
        }
        Ok(config.with(&self.set)?)
    }

    /// The line that continues this run.
    fn resume_command(&self) -> String {
        let mut words = vec!["cnerf train --resume --data".to_owned(), self.data.display().to_string()];
        words.extend(["--out".to_owned(), self.out.display().to_string()]);
        if let Some(stage) = self.stage.to_possible_value() {
            words.extend(["--stage".to_owned(), stage.get_name().to_owned()]);
        }
        let model = self.model.model.as_ref().map(|model| ("--model", model.clone()));
        let lpips = self.lpips.as_ref().map(|lpips| ("--lpips", lpips.display().to_string()));
        words.extend([model, lpips].into_iter().flatten().flat_map(|(option, value)| [option.to_owned(), value]));
        words.join(" ")
    }

    fn dry_run(&self, config: &TrainConfig, inputs: &Inputs, console: &Console) -> anyhow::Result<Outcome> {
        let portraits = inputs.dataset.len();
        let parameters = Parameters::fresh(config.seed, candle_core::DType::F32, &candle_core::Device::Cpu);
        Generator::new(&config.model, &parameters)?;
        let steps = steps(config, self.stage);
        let (mut estimates, mut not_estimated) = (Vec::new(), Vec::new());
        for (stage, found) in estimate(config, self.stage, inputs)? {
            match found {
                Ok(found) => estimates.push(found),
                Err(reason) => not_estimated.push(format!("{stage:?}: {reason}").to_lowercase()),
            }
        }
        let generator_parameters = parameters.count();
        let report =
            DryRun { config: config.clone(), portraits, generator_parameters, steps, estimates, not_estimated };
        console.result(&report, || {
            let text = config.to_toml().unwrap_or_default();
            let sizes = format!("{portraits} portraits · {generator_parameters} parameters · {steps} steps");
            let estimates = report.estimates.iter().map(described);
            let missing = report.not_estimated.iter().map(|stage| format!("no estimate of {stage}"));
            [text, sizes].into_iter().chain(estimates).chain(missing).collect::<Vec<_>>().join("\n")
        })?;
        Ok(Outcome::Done)
    }

    fn listen(&self, mut trainer: Trainer, team: &Team, console: &Console) -> anyhow::Result<Outcome> {
        let interrupt = Interrupt::listen()?;
        let began = std::time::Instant::now();
        let mut bar = console.bar(0, "");
        let (mut model, mut last) = (None, None);
        let mut interrupted = false;
        while let Some(events) = trainer.step()? {
            for event in events {
                match event {
                    Event::Stage { stage, step, total } => {
                        bar.finish_and_clear();
                        bar = console.bar(total as u64, format!("{stage:?}").to_lowercase());
                        bar.set_position(step as u64);
                    }
                    Event::Step(report) => {
                        bar.set_length(report.total as u64);
                        bar.set_position(report.step as u64);
                        let shown = report.metrics.0.iter().take(4).map(|(name, value)| format!("{name} {value:.4}"));
                        bar.set_message(shown.collect::<Vec<_>>().join("  "));
                        last = Some(report);
                    }
                    Event::Samples(path) | Event::Checkpoint(path) => bar.suspend(|| console.note(path.display())),
                    Event::Model(path) => model = Some(path),
                    Event::Warning(text) => bar.suspend(|| console.warn(text)),
                }
            }
            if team.any(interrupt.asked())? {
                if let Some(path) = trainer.checkpoint()? {
                    bar.suspend(|| console.note(path.display()));
                }
                interrupted = true;
                break;
            }
        }
        bar.finish_and_clear();
        let report = Report {
            run: self.out.clone(),
            model,
            steps: last.as_ref().map_or(0, |report| report.step),
            seconds: began.elapsed().as_secs_f64(),
            metrics: last
                .map_or(serde_json::Value::Null, |report| serde_json::to_value(report.metrics).unwrap_or_default()),
            interrupted,
        };
        let resume = self.resume_command();
        console.result(&report, || match &report.model {
            Some(path) if !report.interrupted => format!("{} after {:.0} s", path.display(), report.seconds),
            _ => format!("stopped after step {}; continue with: {resume}", report.steps),
        })?;
        Ok(if interrupted { Outcome::Partial } else { Outcome::Done })
    }
}

/// An estimate in one line.
fn described(estimate: &Estimate) -> String {
    let Estimate { stage, steps, seconds_a_step, seconds, memory_bytes } = estimate;
    let stage = format!("{stage:?}").to_lowercase();
    let memory = memory_bytes.map(|bytes| format!(", {:.1} GB", bytes as f64 / 1e9)).unwrap_or_default();
    let time = match seconds {
        seconds if *seconds < 90.0 => format!("{seconds:.0} s"),
        seconds if *seconds < 5_400.0 => format!("{:.0} min", seconds / 60.0),
        seconds if *seconds < 172_800.0 => format!("{:.1} h", seconds / 3_600.0),
        seconds => format!("{:.0} days", seconds / 86_400.0),
    };
    format!("{stage}: {steps} steps of about {seconds_a_step:.2} s here, {time}{memory}")
}

/// The processes that train together: those that `mpirun` started.
#[cfg(feature = "mpi")]
fn team() -> anyhow::Result<Team> {
    Ok(Team::from_mpi()?)
}

/// One process alone; several would write over each other's run.
#[cfg(not(feature = "mpi"))]
fn team() -> anyhow::Result<Team> {
    let count = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE"].iter().find_map(|name| std::env::var(name).ok());
    match count.filter(|count| count != "1") {
        Some(count) => {
            bail!("{count} processes were started and this cnerf cannot train in several; build it with --features mpi")
        }
        None => Ok(Team::default()),
    }
}
