//! `cnerf eval inversion`: how well held-out photos are inverted.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use cnerf_core::{
    eval::perceptual::Perceptual,
    interop::chart::{Axis, LineChart, Mark, Series, histogram},
    model::generator::Generator,
};
use cnerf_invert::{
    config::InvertConfig,
    evaluation::{EvaluationOptions, Helpers, InversionScore, InversionSummary, People, Variant, invert_one},
    parser::ParserConfig,
};
use serde::Serialize;

use super::{PlotOptions, model_name, shown};
use crate::{
    console::{Console, Outcome},
    options::ModelOptions,
};

const CHARTS: [&str; 3] = ["psnr_over_time", "psnr", "novel_views"];
/// Novel views are gathered by how far they are turned, in steps of this many radians.
const TURN_STEP_RAD: f64 = 0.1;

/// Arguments of `cnerf eval inversion`.
#[derive(Args, Debug)]
pub struct InversionArguments {
    /// Held-out photos: a dataset folder or zip (of `synth --views V --with depth` for other views and depth), or a
    /// folder of photos
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// People to invert
    #[arg(long, default_value_t = 8, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    count: u32,
    /// What to measure: codes alone, tuning without what holds the geometry, or all of it; several make a table
    #[arg(long, value_enum, value_delimiter = ',', default_value = "ours")]
    variant: Vec<Variant>,
    /// Tell the inverter the dataset's camera
    #[arg(long)]
    known_pose: bool,
    /// Tell the inverter the dataset's region masks
    #[arg(long)]
    known_masks: bool,
    #[command(flatten)]
    config: InvertConfig,
    #[command(flatten)]
    parser: ParserConfig,
    /// Begin at the model's mean portrait, not at a guess from photo and regions
    #[arg(long)]
    far_start: bool,
    /// LPIPS weights (safetensors): the perceptual loss, as in `invert`, and the `lpips` column
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    plots: PlotOptions,
}

#[derive(Serialize)]
struct Report {
    model: String,
    data: PathBuf,
    /// The first variant's means.
    #[serde(flatten)]
    summary: InversionSummary,
    variants: Vec<Measured>,
}

#[derive(Serialize)]
struct Measured {
    variant: Variant,
    #[serde(flatten)]
    summary: InversionSummary,
    portraits: Vec<InversionScore>,
    failures: Vec<Failure>,
}

#[derive(Serialize)]
struct Failure {
    input: String,
    error: String,
}

impl InversionArguments {
    /// Inverts everybody by every variant.
    pub fn run(mut self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.config.seed = seed;
        self.config.validate()?;
        self.plots.check(&CHARTS)?;
        let people = People::open(&self.data, self.count as usize, seed)?;
        let generator = self.model.load_or("portrait")?;
        let perceptual = self.lpips.as_ref().map(|path| Perceptual::load(path, &generator.device())).transpose()?;
        let parser = self.parser.load(cnerf_models::parser())?;
        let near = if self.far_start { None } else { self.model.near_start("portrait")? };
        let helpers = Helpers { perceptual: perceptual.as_ref(), parser: parser.as_deref(), near: near.as_ref() };
        let steps = self.config.steps();
        console.note(format_args!(
            "{} people of {} with `{}`: {:?}, {} steps on codes, {} on weights{}",
            people.len(),
            self.data.display(),
            model_name(&self.model),
            self.config.effort,
            steps.pivot(),
            steps.tune,
            if perceptual.is_some() { "" } else { "; no --lpips: no perceptual loss, no LPIPS" },
        ));
        let mut variants = Vec::new();
        for variant in &self.variant {
            variants.push(self.measure(*variant, &generator, &people, helpers, console));
        }
        let Some(first) = variants.first() else { bail!("--variant: name at least one") };
        if variants.iter().all(|measured| measured.portraits.is_empty()) {
            let reason = first.failures.first().map_or("", |failure| failure.error.as_str());
            bail!("none of {} photos could be inverted: {reason}", people.len());
        }
        self.draw(&variants)?;
        let partial = variants.iter().any(|measured| !measured.failures.is_empty());
        let summary = first.summary.clone();
        let report = Report { model: model_name(&self.model).to_owned(), data: self.data, summary, variants };
        console.result(&report, || table(&report.variants))?;
        Ok(if partial { Outcome::Partial } else { Outcome::Done })
    }

    fn measure(
        &self,
        variant: Variant,
        generator: &Generator,
        people: &People,
        helpers: Helpers<'_>,
        console: &Console,
    ) -> Measured {
        let options = EvaluationOptions {
            config: self.config.clone(),
            variant,
            model_name: model_name(&self.model).to_owned(),
            known_pose: self.known_pose,
            known_masks: self.known_masks,
        };
        let (mut portraits, mut failures) = (Vec::new(), Vec::new());
        let bar = console.bar(people.len() as u64, variant.name());
        for index in 0..people.len() {
            let input = people.name(index);
            let result = invert_one(generator, people, index, helpers, &options, &mut |done, all| {
                bar.set_message(format!("{input}: step {done} of {all}"));
            });
            match result {
                Ok(score) => portraits.push(score),
                Err(error) => {
                    bar.suspend(|| console.warn(format_args!("{input}: {error}")));
                    failures.push(Failure { input, error: error.to_string() });
                }
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        Measured { variant, summary: InversionSummary::of(&portraits, failures.len()), portraits, failures }
    }

    fn draw(&self, variants: &[Measured]) -> anyhow::Result<()> {
        let series = |points: fn(&[InversionScore]) -> Vec<(f64, f64)>, mark: Mark| -> Vec<Series> {
            let one = |measured: &Measured| Series {
                name: measured.variant.name().to_owned(),
                points: points(&measured.portraits),
                mark,
            };
            variants.iter().map(one).collect()
        };
        if let Some(path) = self.plots.path("psnr_over_time") {
            let chart = LineChart {
                title: format!(
                    "Error over time, mean of {} photos",
                    variants.first().map_or(0, |one| one.portraits.len())
                ),
                x: Axis::linear("time, seconds").with_zero(),
                y: Axis::linear("PSNR of what a step compared, dB"),
                subtitle: String::new(),
                series: series(mean_curve, Mark::Line),
            };
            chart.save(path)?;
        }
        if let Some(path) = self.plots.path("psnr") {
            let values = variants.iter().map(|measured| {
                (measured.variant.name().to_owned(), measured.portraits.iter().map(|score| score.psnr).collect())
            });
            histogram("Inverted photos", Axis::linear("PSNR, dB"), &values.collect::<Vec<_>>()).save(path)?;
        }
        let novel = series(by_turn, Mark::LineAndDots);
        if let Some(path) = self.plots.path("novel_views").filter(|_| novel.iter().any(|one| !one.points.is_empty())) {
            let chart = LineChart {
                title: "Views that were not shown".into(),
                subtitle: String::new(),
                x: Axis::linear("turn of azimuth from the photo, radians").with_zero(),
                y: Axis::linear("PSNR, dB"),
                series: novel,
            };
            chart.save(path)?;
        }
        Ok(())
    }
}

/// The mean over portraits of time and PSNR after each step.
fn mean_curve(scores: &[InversionScore]) -> Vec<(f64, f64)> {
    let longest = scores.iter().map(|score| score.curve.len()).max().unwrap_or(0);
    let after = |step: usize| {
        let points: Vec<(f64, f64)> = scores.iter().filter_map(|score| score.curve.get(step).copied()).collect();
        let count = points.len().max(1) as f64;
        points.iter().fold((0.0, 0.0), |mean, point| (mean.0 + point.0 / count, mean.1 + point.1 / count))
    };
    (0..longest).map(after).collect()
}

/// Mean PSNR of novel views by how far they are turned.
fn by_turn(scores: &[InversionScore]) -> Vec<(f64, f64)> {
    let mut bins: std::collections::BTreeMap<u64, Vec<f64>> = std::collections::BTreeMap::new();
    for view in scores.iter().flat_map(|score| &score.novel_views) {
        bins.entry((view.azimuth_turn_rad.abs() / TURN_STEP_RAD).round() as u64).or_default().push(view.psnr);
    }
    let point = |(bin, values): (u64, Vec<f64>)| {
        (bin as f64 * TURN_STEP_RAD, values.iter().sum::<f64>() / values.len().max(1) as f64)
    };
    bins.into_iter().map(point).collect()
}

fn table(variants: &[Measured]) -> String {
    let mut lines = vec![format!(
        "{:<8} {:>5} {:>6} {:>8} {:>6} {:>7} {:>6} {:>6} {:>9} {:>6} {:>9} {:>9}",
        "variant",
        "count",
        "failed",
        "seconds",
        "PSNR",
        "MS-SSIM",
        "LPIPS",
        "mIoU",
        "novel, dB",
        "depth",
        "pose, rad",
        "drift"
    )];
    lines.extend(variants.iter().map(|measured| {
        let found = &measured.summary;
        format!(
            "{:<8} {:>5} {:>6} {:>8} {:>6} {:>7} {:>6} {:>6} {:>9} {:>6} {:>9} {:>9}",
            measured.variant.name(),
            found.count,
            found.failed,
            shown(found.seconds, 1),
            shown(found.psnr, 2),
            shown(found.ms_ssim, 3),
            shown(found.lpips, 3),
            shown(found.mask_miou, 3),
            shown(found.novel_view_psnr, 2),
            shown(found.depth_correlation, 3),
            shown(found.pose_error_rad, 3),
            shown(found.depth_drift, 5),
        )
    }));
    lines.join("\n")
}
