//! `cnerf eval consistency`: whether the views of a portrait agree.

use std::path::{Path, PathBuf};

use clap::Args;
use cnerf_core::{
    data::dataset::Dataset,
    eval::consistency::Consistency,
    interop::chart::{Axis, BarChart, histogram},
};
use serde::Serialize;

use super::{PlotOptions, PortraitOptions, shown, table};
use crate::console::{Console, Outcome};

const CHARTS: [&str; 2] = ["reprojection", "detail"];

/// Arguments of `cnerf eval consistency`.
#[derive(Args, Debug)]
pub struct ConsistencyArguments {
    #[command(flatten)]
    portraits: PortraitOptions,
    /// Dataset of heads with depth and several views (`synth --with depth --turns=-0.4,-0.3,-0.05,0.05,0.3,0.4`):
    /// its own pictures are measured beside
    #[arg(long, value_name = "PATH")]
    reference: Option<PathBuf>,
    #[command(flatten)]
    plots: PlotOptions,
}

#[derive(Serialize)]
struct Report {
    count: usize,
    #[serde(flatten)]
    mean: Consistency,
    portraits: Vec<Measured>,
    /// The mean of the reference's heads.
    #[serde(skip_serializing_if = "Option::is_none")]
    reference: Option<Reference>,
    seconds: f64,
}

#[derive(Serialize)]
struct Measured {
    portrait: String,
    #[serde(flatten)]
    consistency: Consistency,
}

#[derive(Serialize)]
struct Reference {
    count: usize,
    #[serde(flatten)]
    mean: Consistency,
}

impl Reference {
    /// Measures the heads of the data set at `path`.
    fn open(path: &Path) -> anyhow::Result<Self> {
        let dataset = Dataset::open(path)?;
        let people = dataset.people();
        let measured = people.iter().map(|views| Consistency::of_truth(&dataset, views));
        let heads: Vec<Consistency> = measured.filter_map(Result::transpose).collect::<Result<_, _>>()?;
        let mean = Consistency::mean(&heads);
        // The depth that is there is not enough where no view is turned as far as is measured.
        if mean.reprojection_psnr.is_none() && mean.detail.iter().all(|detail| detail.correlation.is_none()) {
            let views = "no head with depth and views turned by 0.05, 0.3 or 0.4 rad";
            let remedy = "make some with `cnerf synth --with depth --turns=-0.4,-0.3,-0.05,0.05,0.3,0.4`";
            anyhow::bail!("{}: {views}; {remedy}", path.display());
        }
        Ok(Self { count: heads.len(), mean })
    }
}

impl ConsistencyArguments {
    /// Measures each portrait and reports the mean.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        let began = std::time::Instant::now();
        self.plots.check(&CHARTS)?;
        let reference = self.reference.as_deref().map(Reference::open).transpose()?;
        let portraits = self.portraits.open(seed)?;
        console.note(format_args!("consistency of {}", portraits.described()));
        let bar = console.bar(portraits.len() as u64, "consistency");
        let mut measured = Vec::new();
        for index in 0..portraits.len() {
            let (portrait, consistency) = portraits.visit(index, |subject, _| Ok(Consistency::of(subject)?))?;
            measured.push(Measured { portrait, consistency });
            bar.inc(1);
        }
        bar.finish_and_clear();
        let each: Vec<Consistency> = measured.iter().map(|measured| measured.consistency.clone()).collect();
        let mean = Consistency::mean(&each);
        draw(&self.plots, &each, &mean)?;
        let seconds = began.elapsed().as_secs_f64();
        let report = Report { count: each.len(), mean, portraits: measured, reference, seconds };
        console.result(&report, || summary(&report))?;
        Ok(Outcome::Done)
    }
}

fn draw(plots: &PlotOptions, each: &[Consistency], mean: &Consistency) -> anyhow::Result<()> {
    if let Some(path) = plots.path("reprojection") {
        let column = |value: fn(&Consistency) -> Option<f64>| each.iter().filter_map(value).collect::<Vec<_>>();
        let series = [
            ("between −0.3 and 0.3 rad".to_owned(), column(|found| found.reprojection_psnr)),
            ("between 0 and ±0.3 rad".to_owned(), column(|found| found.reprojection_psnr_from_middle)),
        ];
        histogram("Reprojection of portraits", Axis::linear("PSNR, dB"), &series).save(path)?;
    }
    if let Some(path) = plots.path("detail") {
        let column =
            |value: fn(&cnerf_core::eval::consistency::Detail) -> Option<f64>| mean.detail.iter().map(value).collect();
        let chart = BarChart {
            title: "Fine detail after the warp".into(),
            x_title: "turn of the camera".into(),
            y: Axis::linear("correlation with the middle view"),
            names: mean.detail.iter().map(|detail| format!("±{} rad", detail.turn_rad)).collect(),
            series: vec![
                ("picture".to_owned(), column(|detail| detail.correlation)),
                ("render under it".to_owned(), column(|detail| detail.field_correlation)),
                ("picture, not warped".to_owned(), column(|detail| detail.unwarped_correlation)),
            ],
        };
        chart.save(path)?;
    }
    Ok(())
}

fn summary(report: &Report) -> String {
    let mut text = rows("portraits", report.count, &report.mean);
    if let Some(Reference { count, mean }) = &report.reference {
        text.push_str("\n\n");
        text.push_str(&rows("heads of the reference", *count, mean));
    }
    text
}

fn rows(whose: &str, count: usize, mean: &Consistency) -> String {
    let decibels = |value| format!("{} dB", shown(value, 2));
    let mut rows = vec![
        (whose, count.to_string()),
        ("reprojection, −0.3 to 0.3 rad", decibels(mean.reprojection_psnr)),
        ("reprojection, 0 to ±0.3 rad", decibels(mean.reprojection_psnr_from_middle)),
        ("mask consistency, mIoU", shown(mean.mask_consistency, 3)),
        ("seen from both sides", shown(mean.visible_share, 2)),
    ];
    for (name, detail) in ["detail at ±0.05 rad", "detail at ±0.4 rad"].into_iter().zip(&mean.detail) {
        let line = format!(
            "{}  render {}  not warped {}  flicker {} grey levels (render {})",
            shown(detail.correlation, 3),
            shown(detail.field_correlation, 3),
            shown(detail.unwarped_correlation, 3),
            shown(detail.flicker_grey_levels, 2),
            shown(detail.field_flicker_grey_levels, 2),
        );
        rows.push((name, line));
    }
    table(&rows)
}
