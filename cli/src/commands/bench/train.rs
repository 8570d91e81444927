//! `cnerf bench train`.

use std::process::{Command, Stdio};

use anyhow::{Context as _, bail};
use clap::Args;
use cnerf_core::{
    bench::{
        Machine, measure,
        train::{self, Exactness, Sizes, Step, StepReport},
    },
    kernels::{KERNEL_VARIABLE, Path},
    train::config::Preset,
};
use serde::{Deserialize, Serialize};

use super::{Common, Repeats};
use crate::console::{Console, Outcome};

/// Sizes of networks and renders.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Config {
    /// The smallest networks, for tests
    Tiny,
    /// The built-in models' networks, batch 1
    Cartoon,
    /// The authors' networks and renders, batch 1
    Reference,
}

/// Arguments of `cnerf bench train`.
#[derive(Args, Debug)]
pub struct TrainArguments {
    /// Which sizes
    #[arg(long, value_enum, default_value = "cartoon")]
    config: Config,
    /// What to measure
    #[arg(
        long,
        value_enum,
        value_delimiter = ',',
        default_value = "pivot,generator,training",
        value_name = "STEP[,STEP]"
    )]
    steps: Vec<Step>,
    /// Pictures a step [default: the configuration's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    batch: Option<u16>,
    /// Width and height of renders, a power of two of at least 8 [default: the configuration's]
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u16).range(8..=512))]
    resolution: Option<u16>,
    /// Samples a ray [default: the configuration's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=4096))]
    samples: Option<u16>,
    /// Do one step and print the most memory it took (how this command measures itself)
    #[arg(long, hide = true)]
    probe_memory: bool,
    #[command(flatten)]
    repeats: Repeats,
    #[command(flatten)]
    common: Common,
}

#[derive(Serialize)]
struct Report {
    plain_seconds_per_image: Option<f64>,
    fused_seconds_per_image: f64,
    peak_rss_bytes: Option<u64>,
    gradient_rel_error: f64,
    #[serde(flatten)]
    exactness: Rest,
    steps: Vec<StepReport>,
    sizes: Sizes,
    path: &'static str,
    machine: Machine,
}

/// The exactness besides the gradient's, which has a key of its own.
#[derive(Serialize)]
struct Rest {
    value_rel_error: f64,
    plain_value_rel_error: f64,
    plain_gradient_rel_error: f64,
}

/// What a probing process says.
#[derive(Deserialize, Serialize)]
struct Probe {
    peak_rss_bytes: Option<u64>,
}

impl TrainArguments {
    fn sizes(&self) -> Sizes {
        let sizes = match self.config {
            Config::Tiny => Sizes::of(Preset::Tiny),
            // One at a time: candle's graph of the preset's eight pictures would take 20 GiB.
            Config::Cartoon => Sizes { batch: 1, ..Sizes::of(Preset::Cartoon) },
            Config::Reference => Sizes::reference(),
        };
        Sizes {
            preset: sizes.preset,
            batch: self.batch.map_or(sizes.batch, usize::from),
            resolution: self.resolution.map_or(sizes.resolution, usize::from),
            samples: self.samples.map_or(sizes.samples, usize::from),
        }
    }

    /// Times every step and has its memory watched.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        let sizes = self.sizes();
        let path = self.common.one_path(Path::fastest())?;
        let Some(first) = self.steps.first().copied() else { bail!("--steps: name at least one") };
        if self.probe_memory {
            train::once(first, &sizes, path)?;
            println!("{}", serde_json::to_string(&Probe { peak_rss_bytes: measure::peak_rss_bytes() })?);
            return Ok(Outcome::Done);
        }
        self.common.check(&train::CHARTS)?;
        let spinner = console.spinner("machine's peak");
        let machine = Machine::measure();
        let mut steps = Vec::new();
        for step in &self.steps {
            let needed = sizes.composed_bytes(*step);
            let plain = available_bytes().is_none_or(|available| 1.5 * needed < available);
            if !plain {
                let gib = needed / f64::from(1 << 30);
                console
                    .note(format_args!("{}: candle's operations would take about {gib:.0} GiB; left out", step.name()));
            }
            spinner.set_message(format!("{} step", step.name()));
            let mut report = train::time(*step, &sizes, path, plain, self.repeats.repeats.into())?;
            spinner.set_message(format!("{} step's memory", step.name()));
            report.peak_rss_bytes = self.probe(*step, &sizes, path)?;
            report.plain_peak_rss_bytes = if plain { self.probe(*step, &sizes, Path::Composed)? } else { None };
            steps.push(report);
        }
        spinner.set_message("gradients in f64");
        let exactness = train::exactness(&sizes, path)?;
        spinner.finish_and_clear();
        let charts = train::charts(&steps, path, &sizes, &machine)?;
        let Exactness { value_rel_error, gradient_rel_error, plain_value_rel_error, plain_gradient_rel_error } =
            exactness;
        let Some(head) = steps.first() else { bail!("--steps: name at least one") };
        let report = Report {
            plain_seconds_per_image: head.plain_seconds_per_image,
            fused_seconds_per_image: head.fused_seconds_per_image,
            peak_rss_bytes: head.peak_rss_bytes,
            gradient_rel_error,
            exactness: Rest { value_rel_error, plain_value_rel_error, plain_gradient_rel_error },
            steps,
            sizes,
            path: path.name(),
            machine,
        };
        self.common.publish(console, &report, &charts, || summary(&report))?;
        Ok(Outcome::Done)
    }

    /// The most memory that a process of its own held which did the step once.
    fn probe(&self, step: Step, sizes: &Sizes, path: Path) -> anyhow::Result<Option<u64>> {
        let config = match self.config {
            Config::Tiny => "tiny",
            Config::Cartoon => "cartoon",
            Config::Reference => "reference",
        };
        let mut command = Command::new(std::env::current_exe().context("cannot find this program to run it again")?);
        command.args(["bench", "train", "--probe-memory", "--quiet", "--config", config, "--steps", step.name()]);
        command.args(["--paths", path.name(), "--batch", &sizes.batch.to_string()]);
        command.args(["--resolution", &sizes.resolution.to_string(), "--samples", &sizes.samples.to_string()]);
        command.arg("--out").arg(&self.common.out);
        // The threads are memory too: as many as here.
        command.env("RAYON_NUM_THREADS", measure::threads().to_string()).env_remove(KERNEL_VARIABLE);
        let output = command.stdin(Stdio::null()).output().context("cannot run this program again")?;
        if !output.status.success() {
            bail!(
                "measuring the {} step's memory failed: {}",
                step.name(),
                String::from_utf8_lossy(&output.stderr).trim()
            );
        }
        Ok(serde_json::from_slice::<Probe>(&output.stdout)?.peak_rss_bytes)
    }
}

/// Memory that a new process could have, bytes; none where the system does not tell.
fn available_bytes() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    Some(line.trim().strip_suffix("kB")?.trim().parse::<f64>().ok()? * 1024.0)
}

fn summary(report: &Report) -> String {
    let gib =
        |bytes: Option<u64>| bytes.map_or("?".into(), |bytes| format!("{:.2}", bytes as f64 / f64::from(1 << 30)));
    let line = |step: &StepReport| {
        let plain = step.plain_seconds_per_image.map_or("not measured".into(), |seconds| format!("{seconds:.3} s"));
        format!(
            "{}: {:.3} s an image, {} GiB; candle's operations {plain}, {} GiB; {}× faster",
            step.step.name(),
            step.fused_seconds_per_image,
            gib(step.peak_rss_bytes),
            gib(step.plain_peak_rss_bytes),
            step.speedup.map_or("?".into(), |speedup| format!("{speedup:.1}"))
        )
    };
    let exact = format!(
        "off f64 by {:.1e} in values and {:.1e} in gradients (candle's f32: {:.1e} and {:.1e})",
        report.exactness.value_rel_error,
        report.gradient_rel_error,
        report.exactness.plain_value_rel_error,
        report.exactness.plain_gradient_rel_error
    );
    report.steps.iter().map(line).chain([exact]).collect::<Vec<_>>().join("\n")
}
