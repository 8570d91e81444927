//! `cnerf eval consistency`: whether the views of a portrait agree.

use clap::Args;
use cnerf_core::{
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
    #[command(flatten)]
    plots: PlotOptions,
}

#[derive(Serialize)]
struct Report {
    count: usize,
    #[serde(flatten)]
    mean: Consistency,
    portraits: Vec<Measured>,
    seconds: f64,
}

#[derive(Serialize)]
struct Measured {
    portrait: String,
    #[serde(flatten)]
    consistency: Consistency,
}

impl ConsistencyArguments {
    /// Measures each portrait and reports the mean.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        let began = std::time::Instant::now();
        self.plots.check(&CHARTS)?;
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
        let report = Report { count: each.len(), mean, portraits: measured, seconds: began.elapsed().as_secs_f64() };
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
    let mean = &report.mean;
    let decibels = |value| format!("{} dB", shown(value, 2));
    let mut rows = vec![
        ("portraits", report.count.to_string()),
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
