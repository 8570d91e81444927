//! `cnerf bench render`.

use clap::Args;
use cnerf_core::{
    bench::{
        Machine,
        render::{self, BUDGETS, Report},
    },
    kernels::Path,
};

use super::{Common, Repeats, scene::SceneArguments};
use crate::console::{Console, Outcome};

/// Arguments of `cnerf bench render`.
#[derive(Args, Debug)]
pub struct RenderArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// Budgets of error to render under, [0, 1] colour units [default: six from 0.0005 to 0.03]
    #[arg(long, value_name = "E[,E]", value_delimiter = ',', value_parser = super::parse_budget)]
    budgets: Vec<f64>,
    #[command(flatten)]
    repeats: Repeats,
    #[command(flatten)]
    common: Common,
}

impl RenderArguments {
    /// Measures one frame.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.common.check(&render::CHARTS)?;
        let fast = Path::available().filter(|path| !matches!(path.name(), "plain" | "composed"));
        let paths = self.common.paths(fast)?;
        let scene = self.scene.scene(seed)?;
        let budgets = if self.budgets.is_empty() { BUDGETS.as_slice() } else { &self.budgets };
        let spinner = console.spinner("machine's peak");
        let machine = Machine::measure();
        let report = render::run(&scene, &paths, budgets, self.repeats.repeats.into(), machine, &mut |step| {
            spinner.set_message(step.to_owned());
        })?;
        spinner.finish_and_clear();
        self.common.publish(console, &report, &render::charts(&report)?, || summary(&report))?;
        Ok(Outcome::Done)
    }
}

fn summary(report: &Report) -> String {
    let mut lines = vec![format!(
        "exact frame {:.4} s, {:.0} of {:.0} GFLOP/s; candle's operations {:.3} s ({:.1}× slower)",
        report.exact_seconds,
        report.gflops,
        report.peak_gflops,
        report.plain_seconds,
        report.plain_seconds / report.exact_seconds
    )];
    lines.extend(report.generators.iter().map(|speed| {
        let (work, share) = (speed.work, 100.0 * speed.share_of_peak);
        format!("local generators, {work:?} on {}: {:.0} GFLOP/s, {share:.0} % of peak", speed.path, speed.gflops)
    }));
    lines.extend(report.budgeted.iter().map(|budget| {
        format!(
            "budget {:.4}: {:.4} s, {:.1}× over exact, error {:.5} (bound {:.5})",
            budget.budget, budget.seconds, budget.speedup, budget.max_error, budget.bound
        )
    }));
    lines.extend(report.discretisation.iter().map(|sum| {
        format!("{:.1} samples, {}: {:.1} dB in {:.4} s", sum.samples, sum.placement, sum.psnr, sum.seconds)
    }));
    lines.extend(report.samples_for_40_db.map(|[uniform, surface]| {
        format!("40 dB: {uniform:.1} samples a ray where uniform, {surface:.1} at the surface")
    }));
    lines.join("\n")
}
