//! `cnerf bench conv`.

use clap::Args;
use cnerf_core::{
    bench::{Machine, conv},
    kernels::Path,
};

use super::{Common, Repeats};
use crate::console::{Console, Outcome};

/// Sizes of the convolutions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Config {
    /// A fraction of the authors' sizes
    Small,
    /// The authors' sizes
    Reference,
}

/// Arguments of `cnerf bench conv`.
#[derive(Args, Debug)]
pub struct ConvArguments {
    /// Which sizes
    #[arg(long, value_enum, default_value = "reference")]
    config: Config,
    #[command(flatten)]
    repeats: Repeats,
    #[command(flatten)]
    common: Common,
}

const CHART: &str = "conv.svg";

impl ConvArguments {
    /// Times every pass at every shape.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        self.common.check(&[CHART])?;
        // The loops of the definition would take minutes at these sizes; they are there for tests.
        let fast = Path::available().filter(|path| !matches!(path.name(), "plain" | "composed"));
        let paths = self.common.paths(fast)?;
        let shapes = match self.config {
            Config::Small => conv::Shape::SMALL.as_slice(),
            Config::Reference => conv::Shape::REFERENCE.as_slice(),
        };
        let spinner = console.spinner("machine's peak");
        let machine = Machine::measure();
        let rows = conv::run(shapes, &paths, self.repeats.repeats.into(), &machine, &mut |step| {
            spinner.set_message(step.to_owned());
        })?;
        spinner.finish_and_clear();
        let charts = [(CHART, conv::chart(&rows, &machine)?)];
        self.common.publish(console, &rows, &charts, || {
            let line = |row: &conv::Row| {
                let share = 100.0 * row.gflops / row.peak_gflops;
                format!(
                    "{} {:?} {}: {:.0} GFLOP/s, {share:.0} % of peak, {:.1}× candle",
                    row.shape,
                    row.pass,
                    row.path,
                    row.gflops,
                    row.gflops / row.plain_gflops
                )
            };
            rows.iter().map(line).collect::<Vec<_>>().join("\n")
        })?;
        Ok(Outcome::Done)
    }
}
