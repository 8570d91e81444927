//! `cnerf bench stability`.

use clap::Args;
use cnerf_core::{
    bench::{Machine, stability},
    interop::chart::{Axis, LineChart, Mark, Series},
    kernels::Path,
};

use super::Common;
use crate::console::{Console, Outcome};

/// Arguments of `cnerf bench stability`.
#[derive(Args, Debug)]
pub struct StabilityArguments {
    /// Only cases whose name contains this
    #[arg(long, default_value = "", value_name = "TEXT", hide_default_value = true)]
    only: String,
    #[command(flatten)]
    common: Common,
}

const CHART: &str = "stability.svg";

impl StabilityArguments {
    /// Runs every case on every path; exit code 1 if one fails.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        self.common.check(&[CHART])?;
        let paths = self.common.paths(Path::available())?;
        let count = stability::count(&self.only);
        if count == 0 {
            anyhow::bail!("--only {}: no case's name contains it", self.only);
        }
        let bar = console.bar(count as u64, "stability");
        let report = stability::run(&paths, &self.only, &mut |name| {
            bar.inc(1);
            bar.set_message(name.to_owned());
        })?;
        bar.finish_and_clear();
        self.common.publish(console, &report, &[(CHART, chart(&report)?)], || {
            let failed = report.cases.iter().filter(|case| !case.passed).map(|case| {
                format!(
                    "FAILED {}: {} off by {:.1e} > {:.1e} on {}{}",
                    case.name,
                    case.quantity,
                    case.error,
                    case.bound,
                    case.path,
                    if case.finite { "" } else { ", not finite" }
                )
            });
            let total = format!(
                "{} cases on {}: {} passed, {} failed",
                report.cases.len(),
                report.paths.join(", "),
                report.cases.len() - report.failed,
                report.failed
            );
            failed.chain([total]).collect::<Vec<_>>().join("\n")
        })?;
        Ok(if report.failed == 0 { Outcome::Done } else { Outcome::Partial })
    }
}

/// Every case's error beside its bound: what lies above the dashed line failed.
fn chart(report: &stability::Report) -> cnerf_core::Result<String> {
    let points = report.cases.iter().map(|case| (case.bound, case.error.max(1e-12))).collect();
    let ends = report
        .cases
        .iter()
        .map(|case| case.bound)
        .fold((1.0, 1e-9), |(low, high): (f64, f64), bound| (low.min(bound), high.max(bound)));
    let machine = Machine::measure();
    let title = format!("Error against f64, {} cases on {}", report.cases.len(), report.paths.join(", "));
    LineChart {
        title,
        subtitle: machine.describe(),
        x: Axis::logarithmic("bound derived from the numbers' conditioning, relative L2"),
        y: Axis::logarithmic("error of f32, relative L2 (exact ones at 1e-12)"),
        series: vec![
            Series { name: "a case's value or gradient closest to its bound".into(), points, mark: Mark::Dots },
            Series { name: "the bound".into(), points: vec![(ends.0, ends.0), (ends.1, ends.1)], mark: Mark::Limit },
        ],
    }
    .svg()
}
