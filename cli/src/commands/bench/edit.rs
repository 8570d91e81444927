//! `cnerf bench edit`.

use clap::Args;
use cnerf_core::{
    bench::{Machine, edit},
    kernels::Path,
    region::Region,
};

use super::{Common, Repeats, scene::SceneArguments};
use crate::console::{Console, Outcome};

/// Arguments of `cnerf bench edit`.
#[derive(Args, Debug)]
pub struct EditArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// The region that is edited
    #[arg(long, default_value = "hair", value_name = "REGION")]
    region: Region,
    /// Largest error allowed, [0, 1] colour units
    #[arg(long, default_value_t = 0.002, value_name = "E", value_parser = super::parse_budget)]
    budget: f64,
    #[command(flatten)]
    repeats: Repeats,
    #[command(flatten)]
    common: Common,
}

impl EditArguments {
    /// Edits back and forth.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.common.check(&[edit::CHART])?;
        let path = self.common.one_path(Path::fastest())?;
        let scene = self.scene.scene(seed)?;
        let spinner = console.spinner("machine's peak");
        let machine = Machine::measure();
        let repeats = self.repeats.repeats.into();
        let report = edit::run(&scene, path, self.region, self.budget, repeats, machine, &mut |step| {
            spinner.set_message(step.to_owned());
        })?;
        spinner.finish_and_clear();
        let charts = [(edit::CHART, edit::chart(&report)?)];
        self.common.publish(console, &report, &charts, || {
            let line = |edit: &edit::EditReport| {
                format!(
                    "{} of the {}: whole frame {:.4} s, incremental {:.4} s ({:.1}×), error {:.5} (bound {:.5})",
                    edit.aspect,
                    edit.region,
                    edit.full_seconds,
                    edit.incremental_seconds,
                    edit.speedup,
                    edit.max_error,
                    edit.bound
                )
            };
            report.edits.iter().map(line).collect::<Vec<_>>().join("\n")
        })?;
        Ok(Outcome::Done)
    }
}
