//! `cnerf train-parser`: teaches the network that finds regions, head pose, eyes and mouth in aligned portraits.

use std::{
    io::Write as _,
    path::{Path, PathBuf},
    time::Instant,
};

use anyhow::{Context as _, bail};
use clap::Args;
use cnerf_core::{
    data::dataset::Dataset,
    parsing::{ParserStep, ParserTrainer, ParserTraining},
};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    interrupt::{Interrupt, command_to_resume},
};

/// Steps between two checkpoints.
const CHECKPOINT_EVERY: usize = 200;
/// Steps between two lines of the log.
const LOG_EVERY: usize = 20;

/// Arguments of `cnerf train-parser`.
#[derive(Args, Debug)]
pub struct TrainParserArguments {
    /// Dataset of aligned portraits with label maps: a folder or a zip; may repeat
    #[arg(long, value_name = "PATH", required = true)]
    data: Vec<PathBuf>,
    /// Folder of the run: parser.safetensors, checkpoint.safetensors, log.jsonl
    #[arg(long, value_name = "RUN")]
    out: PathBuf,
    #[command(flatten)]
    training: ParserTraining,
    /// Continue the run in --out
    #[arg(long)]
    resume: bool,
}

#[derive(Serialize)]
struct Report {
    parser: PathBuf,
    parameters: usize,
    seconds: f64,
    interrupted: bool,
    #[serde(flatten)]
    last: Option<ParserStep>,
}

impl TrainParserArguments {
    /// Trains until done or interrupted.
    pub fn run(mut self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.training.seed = seed;
        self.training.validate()?;
        let file = |name: &str| self.out.join(name);
        let (model, checkpoint) = (file("parser.safetensors"), file("checkpoint.safetensors"));
        if !self.resume && (model.exists() || checkpoint.exists()) {
            bail!("{}: holds a run; pass --resume to go on with it, or choose another folder", self.out.display());
        }
        let datasets = self.data.iter().map(Dataset::open).collect::<Result<Vec<_>, _>>()?;
        std::fs::create_dir_all(&self.out).with_context(|| self.out.display().to_string())?;
        let interrupt = Interrupt::listen()?;
        let bar = console.bar(0, "examples");
        let mut trainer = ParserTrainer::new(self.training.clone(), &datasets, &mut |done, all| {
            bar.set_length(all as u64);
            bar.set_position(done as u64);
        })?;
        bar.finish_and_clear();
        if self.resume {
            trainer.resume(&checkpoint)?;
        }
        console.note(format_args!("{} portraits, {} weights", trainer.examples(), trainer.parameter_count()));
        let began = Instant::now();
        let bar = console.bar(self.training.steps as u64, "parser");
        let (mut last, mut interrupted) = (None, false);
        while let Some(step) = trainer.step()? {
            bar.set_position(step.step as u64);
            bar.set_message(format!("cross-entropy {:.4}  accuracy {:.3}", step.cross_entropy, step.accuracy));
            if step.step % LOG_EVERY == 0 {
                log(&file("log.jsonl"), &step)?;
            }
            last = Some(step);
            interrupted = interrupt.asked();
            if interrupted || step.step % CHECKPOINT_EVERY == 0 || step.step == step.total {
                trainer.checkpoint(&checkpoint)?;
                trainer.write(&model, &self.provenance(step.step, trainer.examples()))?;
            }
            if interrupted {
                break;
            }
        }
        bar.finish_and_clear();
        let seconds = began.elapsed().as_secs_f64();
        let parameters = trainer.parameter_count();
        let report = Report { parser: model, parameters, seconds, interrupted, last };
        console.result(&report, || match (&report.last, report.interrupted) {
            (_, true) => format!("stopped; go on with: {}", command_to_resume()),
            (Some(last), _) => format!("{} after {} steps", report.parser.display(), last.step),
            (None, _) => format!("{}: nothing left to do", report.parser.display()),
        })?;
        Ok(if interrupted { Outcome::Partial } else { Outcome::Done })
    }

    fn provenance(&self, steps: usize, examples: usize) -> String {
        let names = self.data.iter().filter_map(|path| path.file_name()).map(|name| name.to_string_lossy());
        let data = names.collect::<Vec<_>>().join(", ");
        let ParserTraining { batch, cartoons, seed, .. } = self.training;
        format!("{steps} steps of {batch} from {examples} portraits ({data}; {cartoons} cartoons), seed {seed}")
    }
}

/// Appends a step to the run's log.
fn log(path: &Path, step: &ParserStep) -> anyhow::Result<()> {
    let line = serde_json::to_string(step)?;
    let mut file = std::fs::OpenOptions::new().create(true).append(true).open(path);
    file.as_mut()
        .map_err(|error| anyhow::anyhow!("{}: {error}", path.display()))
        .and_then(|file| writeln!(file, "{line}").with_context(|| path.display().to_string()))
}
