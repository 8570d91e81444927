//! `cnerf eval inversion`: how well held-out photos are inverted.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::Args;
use cnerf_core::{
    interop::chart::{Axis, LineChart, Mark, Series, histogram},
    model::generator::Generator,
};
use cnerf_invert::{
    config::{Effort, InvertConfig},
    evaluation::{EvaluationOptions, Helpers, InversionScore, InversionSummary, People, Scores, Variant, invert_one},
    likeness::Likeness,
    parser::ParserConfig,
};
use serde::Serialize;

use super::{PlotOptions, model_name, shown};
use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, stem},
};

const CHARTS: [&str; 5] = ["psnr_over_time", "psnr", "novel_views", "psnr_over_effort", "lpips_over_effort"];
/// Columns of the table: novel views turned so far, radians.
const TURNS_SHOWN_RAD: [f64; 2] = [0.2, 0.4];

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
    /// Measure at each of these efforts, in place of --effort: a row for each, and charts of time against error
    #[arg(long, value_enum, value_name = "EFFORT[,EFFORT]", value_delimiter = ',', conflicts_with = "effort")]
    efforts: Vec<Effort>,
    /// Folder for the portraits of the table's first row: `examples/inversion_sheet` and other commands take them
    #[arg(long, value_name = "DIR")]
    portraits: Option<PathBuf>,
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
    /// LPIPS weights (safetensors): the perceptual loss in place of the built-in parser's features, and the `lpips` column
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
    /// The first row's means.
    #[serde(flatten)]
    summary: InversionSummary,
    /// The table's rows.
    variants: Vec<Measured>,
}

/// A row of the table.
#[derive(Serialize)]
struct Measured {
    effort: Effort,
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
        let likeness = Likeness::load(self.lpips.as_deref(), cnerf_models::parser(), &generator.device())?;
        let parser = self.parser.load(cnerf_models::parser())?;
        let near = if self.far_start { None } else { self.model.near_start("portrait")? };
        let helpers = Helpers { likeness: Some(&likeness), parser: parser.as_deref(), near: near.as_ref() };
        let efforts = if self.efforts.is_empty() { vec![self.config.effort] } else { self.efforts.clone() };
        let rows: Vec<(Effort, Variant)> =
            efforts.iter().flat_map(|effort| self.variant.iter().map(|variant| (*effort, *variant))).collect();
        if let Some(folder) = &self.portraits {
            let mut paths: Vec<PathBuf> = (0..people.len()).map(|one| portrait_path(folder, &people, one)).collect();
            paths.iter().try_for_each(|path| self.plots.overwrite.check(path))?;
            paths.sort();
            if let Some(path) = paths.iter().zip(paths.iter().skip(1)).find_map(|(a, b)| (a == b).then_some(a)) {
                bail!("two photos would become {}: rename one, or leave --portraits out", path.display());
            }
        }
        let mut variants = Vec::new();
        for (row, (effort, variant)) in rows.into_iter().enumerate() {
            let config = InvertConfig { effort, ..self.config.clone() };
            let steps = config.steps();
            console.note(format_args!(
                "{} people of {} with `{}`: {}, {}, {} steps on codes, {} on weights{}",
                people.len(),
                self.data.display(),
                model_name(&self.model),
                variant.name(),
                effort.name(),
                steps.pivot(),
                variant.apply(config.clone()).steps().tune,
                if self.lpips.is_some() { "" } else { "; no --lpips: no LPIPS" },
            ));
            let options = EvaluationOptions {
                config,
                variant,
                model_name: model_name(&self.model).to_owned(),
                known_pose: self.known_pose,
                known_masks: self.known_masks,
            };
            let folder = self.portraits.as_deref().filter(|_| row == 0);
            variants.push(measure(&generator, &people, helpers, &options, folder, console));
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

    fn draw(&self, variants: &[Measured]) -> anyhow::Result<()> {
        let several = variants.iter().any(|one| variants.first().is_some_and(|first| first.effort != one.effort));
        let name = |measured: &Measured| match several {
            true => format!("{}, {}", measured.variant.name(), measured.effort.name()),
            false => measured.variant.name().to_owned(),
        };
        let series = |points: &dyn Fn(&Measured) -> Vec<(f64, f64)>, mark: Mark| -> Vec<Series> {
            variants.iter().map(|one| Series { name: name(one), points: points(one), mark }).collect()
        };
        let count = variants.first().map_or(0, |one| one.portraits.len());
        let save = |name: &str, title: String, x: Axis, y: Axis, series: Vec<Series>| -> anyhow::Result<()> {
            // A chart without a point would say nothing.
            if let Some(path) = self.plots.path(name).filter(|_| series.iter().any(|one| !one.points.is_empty())) {
                LineChart { title, subtitle: String::new(), x, y, series }.save(path)?;
            }
            Ok(())
        };
        save(
            "psnr_over_time",
            format!("Error over time, mean of {count} photos"),
            Axis::linear("time, seconds").with_zero(),
            Axis::linear("PSNR of what a step compared, dB"),
            series(&|one| mean_curve(&one.portraits), Mark::Line),
        )?;
        if let Some(path) = self.plots.path("psnr") {
            let values =
                variants.iter().map(|one| (name(one), one.portraits.iter().map(|score| score.scores.psnr).collect()));
            histogram("Inverted photos", Axis::linear("PSNR, dB"), &values.collect::<Vec<_>>()).save(path)?;
        }
        let by_turn = |one: &Measured| {
            one.summary.novel_views_by_turn.iter().map(|turn| (turn.turn_rad, turn.psnr)).collect::<Vec<_>>()
        };
        save(
            "novel_views",
            "Views that were not shown".into(),
            Axis::linear("turn of azimuth from the photo, radians").with_zero(),
            Axis::linear("PSNR, dB"),
            series(&by_turn, Mark::LineAndDots),
        )?;
        if !several {
            return Ok(());
        }
        let seconds = || Axis::logarithmic("wall time of a photo, seconds");
        let mut both = over_effort(variants, "", |found| Some(found.psnr));
        both.extend(over_effort(variants, ", views not shown", |found| found.novel_view_psnr));
        let title = format!("Time against error, mean of {count} photos");
        save("psnr_over_effort", title.clone(), seconds(), Axis::linear("PSNR, dB"), both)?;
        let distances = over_effort(variants, "", |found| found.lpips);
        save("lpips_over_effort", title, seconds(), Axis::linear("LPIPS, less is better"), distances)
    }
}

/// Inverts everybody by one variant at one effort; portraits go to `folder`, if there is one.
fn measure(
    generator: &Generator,
    people: &People,
    helpers: Helpers<'_>,
    options: &EvaluationOptions,
    folder: Option<&Path>,
    console: &Console,
) -> Measured {
    let (effort, variant) = (options.config.effort, options.variant);
    let (mut portraits, mut failures) = (Vec::new(), Vec::new());
    let bar = console.bar(people.len() as u64, variant.name());
    for index in 0..people.len() {
        let input = people.name(index);
        let result = invert_one(generator, people, index, helpers, options, &mut |done, all| {
            bar.set_message(format!("{input}: step {done} of {all}"));
        });
        let result = result.and_then(|(score, portrait)| {
            folder.map_or(Ok(()), |folder| portrait.save(&portrait_path(folder, people, index)))?;
            Ok(score)
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
    Measured { effort, variant, summary: InversionSummary::of(&portraits, failures.len()), portraits, failures }
}

/// Where a person's portrait goes: named like the photo, as `invert` names it.
fn portrait_path(folder: &Path, people: &People, index: usize) -> PathBuf {
    folder.join(stem(Path::new(&people.name(index)))).with_extension("cnerf")
}

/// For each variant a line over efforts: mean time, and what `value` takes of the means.
fn over_effort(rows: &[Measured], suffix: &str, value: fn(&Scores) -> Option<f64>) -> Vec<Series> {
    let mut lines: Vec<Series> = Vec::new();
    for row in rows {
        let Some(value) = value(&row.summary.mean) else { continue };
        let name = format!("{}{suffix}", row.variant.name());
        let point = (row.summary.mean.seconds, value);
        match lines.iter_mut().find(|line| line.name == name) {
            Some(line) => line.points.push(point),
            None => lines.push(Series { name, points: vec![point], mark: Mark::LineAndDots }),
        }
    }
    lines.iter_mut().for_each(|line| line.points.sort_by(|a, b| a.0.total_cmp(&b.0)));
    lines
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

fn table(rows: &[Measured]) -> String {
    let turned = TURNS_SHOWN_RAD.map(|turn| format!("±{turn}, dB"));
    let heads = ["count", "failed", "seconds", "PSNR", "MS-SSIM", "LPIPS", "mIoU", "novel, dB"];
    let heads = heads.iter().copied().chain(turned.iter().map(String::as_str)).chain(["depth", "pose, rad", "drift"]);
    let line = |effort: &str, variant: &str, cells: Vec<String>| {
        let cells = cells.iter().map(|cell| format!(" {cell:>9}")).collect::<String>();
        format!("{effort:<8} {variant:<7}{cells}")
    };
    let mut lines = vec![line("effort", "variant", heads.map(str::to_owned).collect())];
    lines.extend(rows.iter().map(|row| {
        let found = &row.summary;
        let mut cells = vec![
            found.count.to_string(),
            found.failed.to_string(),
            shown(found.mean.seconds, 1),
            shown(found.mean.psnr, 2),
            shown(found.mean.ms_ssim, 3),
            shown(found.mean.lpips, 3),
            shown(found.mean.mask_miou, 3),
            shown(found.mean.novel_view_psnr, 2),
        ];
        cells.extend(TURNS_SHOWN_RAD.map(|turn| shown(found.turned(turn).map(|turned| turned.psnr), 2)));
        cells.extend([
            shown(found.mean.depth_correlation, 3),
            shown(found.mean.pose_error_rad, 3),
            shown(found.mean.depth_drift, 5),
        ]);
        line(row.effort.name(), row.variant.name(), cells)
    }));
    lines.join("\n")
}
