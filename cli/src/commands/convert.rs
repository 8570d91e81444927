//! `cnerf convert`: the authors' PyTorch checkpoints as models.

use std::path::PathBuf;

use clap::Args;
use cnerf_core::interop::authors_checkpoint;
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::OverwriteOptions,
};

/// Arguments of `cnerf convert`.
#[derive(Args, Debug)]
pub struct ConvertArguments {
    /// A stage-1 or full checkpoint, .pt; nothing in it is executed
    checkpoint: PathBuf,
    /// Model to write
    #[arg(long, value_name = "X.safetensors")]
    out: PathBuf,
    /// Take the weights called `g` instead of their moving average `g_ema`
    #[arg(long)]
    raw: bool,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    parameters: usize,
    stage: &'static str,
    hash: String,
}

impl ConvertArguments {
    /// Reads, renames, writes.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        self.overwrite.check(&self.out)?;
        let generator = authors_checkpoint::read(&self.checkpoint, self.raw)?;
        let provenance = format!("imported from {}", self.checkpoint.display());
        let header = generator.save(&self.out, "imported", &provenance)?;
        let stage = if generator.upsampler().is_some() { "full" } else { "field" };
        let report = Report { output: self.out, parameters: generator.parameters().count(), stage, hash: header.hash };
        console.result(&report, || {
            format!("{}: {} model, {} parameters", report.output.display(), report.stage, report.parameters)
        })?;
        Ok(Outcome::Done)
    }
}
