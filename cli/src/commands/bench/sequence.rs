//! `cnerf bench sequence`.

use clap::Args;
use cnerf_core::{
    bench::{Machine, sequence},
    kernels::Path,
};

use super::{Common, scene::SceneArguments};
use crate::console::{Console, Outcome};

/// Arguments of `cnerf bench sequence`.
#[derive(Args, Debug)]
pub struct SequenceArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Frames of the orbit
    #[arg(long, default_value_t = 60, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=10_000))]
    frames: u16,
    /// Largest error allowed, [0, 1] colour units [default: 2/255]
    #[arg(long, value_name = "E", value_parser = super::parse_budget)]
    budget: Option<f64>,
    #[command(flatten)]
    common: Common,
}

impl SequenceArguments {
    /// Renders the orbit exactly and over shared geometry.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.common.check(&[sequence::CHART])?;
        let path = self.common.one_path(Path::fastest())?;
        let scene = self.scene.scene(seed)?;
        let budget = self.budget.unwrap_or(2.0 / 255.0);
        let bar = console.bar(self.frames.into(), "sequence");
        let machine = Machine::measure();
        let report = sequence::run(&scene, path, self.frames.into(), budget, machine, &mut |frame| {
            bar.set_position(frame as u64);
        })?;
        bar.finish_and_clear();
        let charts = [(sequence::CHART, sequence::chart(&report)?)];
        self.common.publish(console, &report, &charts, || {
            format!(
                "{} frames: exact {:.4} s a frame, shared {:.4} s ({:.1}×), largest error {:.4} (budget {:.4})",
                report.frames,
                report.exact_seconds_per_frame,
                report.shared_seconds_per_frame,
                report.speedup,
                report.max_error,
                report.budget
            )
        })?;
        Ok(Outcome::Done)
    }
}
