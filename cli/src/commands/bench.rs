//! `cnerf bench`: the suite's speed and exactness beside the plain path, in one run; `report.json` and charts.

mod conv;
mod edit;
mod render;
mod scene;
mod sequence;
mod stability;
mod train;

use std::path::PathBuf;

use anyhow::Context as _;
use clap::{Args, Subcommand};
use cnerf_core::{data::picture, kernels::Path};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::OverwriteOptions,
};

/// The subjects.
#[derive(Subcommand, Debug)]
pub enum BenchCommand {
    /// One frame: exact on every kernel path, under budgets of error, and against the converged integral
    Render(render::RenderArguments),
    /// An orbit: exact frames, and frames over shared geometry
    Sequence(sequence::SequenceArguments),
    /// A view rendered again after an edit: whole, and only what the edit changed
    Edit(edit::EditArguments),
    /// Convolutions of the networks' shapes, against candle's own
    Conv(conv::ConvArguments),
    /// Training steps: speed, memory and exact gradients, against candle's own operations
    Train(Box<train::TrainArguments>),
    /// Numbers under abuse: every part at the ends of its range, in f32 on every path, against f64
    Stability(stability::StabilityArguments),
}

impl BenchCommand {
    /// Measures one subject.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        match self {
            Self::Render(render) => render.run(seed, console),
            Self::Sequence(sequence) => sequence.run(seed, console),
            Self::Edit(edit) => edit.run(seed, console),
            Self::Conv(conv) => conv.run(console),
            Self::Train(train) => train.run(console),
            Self::Stability(stability) => stability.run(console),
        }
    }
}

/// The report's name in the output folder.
const REPORT: &str = "report.json";

/// Where results go, and on which paths they are measured.
#[derive(Args, Clone, Debug)]
struct Common {
    /// Folder for report.json and charts
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Kernel paths to measure, one after another: avx512, avx2, portable, plain, composed [default: what the subject needs]
    #[arg(long, value_name = "NAME[,NAME]", value_delimiter = ',')]
    paths: Vec<String>,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

/// How often.
#[derive(Args, Clone, Copy, Debug)]
struct Repeats {
    /// Timed rounds, after one that is not; medians are reported
    #[arg(long, default_value_t = 5, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1000))]
    repeats: u16,
}

impl Common {
    /// The paths asked for, or `default`.
    fn paths(&self, default: impl IntoIterator<Item = Path>) -> anyhow::Result<Vec<Path>> {
        if self.paths.is_empty() {
            return Ok(default.into_iter().collect());
        }
        let named = |name: &String| Path::named(name).map_err(|error| anyhow::anyhow!("--paths {name}: {error}"));
        self.paths.iter().map(named).collect()
    }

    /// The one path asked for, or `default`: for what is compared to candle's operations or to itself.
    fn one_path(&self, default: Path) -> anyhow::Result<Path> {
        match self.paths([default])?.as_slice() {
            [path] => Ok(*path),
            paths => anyhow::bail!("--paths: this measures one path at a time, not {}", paths.len()),
        }
    }

    /// Refuses to replace earlier results before anything is measured.
    fn check(&self, charts: &[&str]) -> anyhow::Result<()> {
        charts.iter().chain(&[REPORT]).try_for_each(|name| self.overwrite.check(&self.out.join(name)))
    }

    /// Writes the report and the charts, and prints the one or a summary.
    fn publish<T: Serialize>(
        &self,
        console: &Console,
        report: &T,
        charts: &[(&str, String)],
        summary: impl FnOnce() -> String,
    ) -> anyhow::Result<()> {
        std::fs::create_dir_all(&self.out).with_context(|| format!("{}", self.out.display()))?;
        for (name, svg) in charts {
            picture::write_file(&self.out.join(name), svg.as_bytes())?;
        }
        let text = serde_json::to_string_pretty(report)?;
        picture::write_file(&self.out.join(REPORT), text.as_bytes())?;
        console.result(report, || format!("{}\n{}", summary(), self.out.join(REPORT).display()))
    }
}

/// An error budget, [0, 1] colour units.
fn parse_budget(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(budget) if (0.0..=1.0).contains(&budget) => Ok(budget),
        _ => Err("must be a number between 0 and 1".into()),
    }
}
