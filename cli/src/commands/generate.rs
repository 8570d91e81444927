//! `cnerf generate`: random portraits.

use std::path::PathBuf;

use clap::Args;
use cnerf_core::{camera::Camera, data::picture, interop::sheet::Sheet, region::RegionSet, render::plan::FrameReport};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions, parse_seeds},
    views::{Scene, View},
};

/// Arguments of `cnerf generate`.
#[derive(Args, Debug)]
pub struct GenerateArguments {
    /// Seeds, e.g. 0,4-7: a seed is a portrait
    #[arg(long, default_value = "0-15", value_name = "LIST", value_parser = parse_seeds)]
    seeds: ::std::vec::Vec<u64>,
    /// Truncation: 1 draws from all portraits, 0 gives the mean portrait
    #[arg(long, default_value_t = 0.7, value_name = "PSI", value_parser = truncation, allow_negative_numbers = true)]
    trunc: f64,
    /// Folder to write to
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What to render
    #[arg(long, value_enum, value_delimiter = ',', default_value = "rgb")]
    output: Vec<View>,
    /// Render only these regions
    #[arg(long, default_value = "all", value_name = "R[,R]")]
    regions: RegionSet,
    /// Camera's angle around the head, radians
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    azimuth: f64,
    /// Camera's angle above the horizon, radians
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true)]
    elevation: f64,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Serialize)]
struct Report {
    files: Vec<PathBuf>,
    grid: PathBuf,
    seconds: f64,
    /// Of all renders together.
    plan: Option<FrameReport>,
}

impl GenerateArguments {
    /// Renders every seed.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        let grid = self.out.join("grid.png");
        let file = |seed: u64, view: View| match view {
            View::Rgb => self.out.join(format!("seed{seed:04}.png")),
            other => self.out.join(format!("seed{seed:04}_{}.png", other.name())),
        };
        self.overwrite.check(&grid)?;
        for seed in &self.seeds {
            self.output.iter().try_for_each(|view| self.overwrite.check(&file(*seed, *view)))?;
        }
        let began = std::time::Instant::now();
        let generator = self.model.load_or("portrait")?;
        let camera = Camera::at(self.azimuth, self.elevation);
        let bar = console.bar(self.seeds.len() as u64, "generate");
        let mut files = Vec::new();
        let mut plan: Option<FrameReport> = None;
        let mut sheet = Sheet::near_square(self.seeds.len());
        for seed in &self.seeds {
            let codes = generator.codes_from_seed(*seed, self.trunc)?;
            let scene = Scene { generator: &generator, codes: &codes, global: None, regions: self.regions };
            let shown = scene.pictures(&camera, &self.output, None)?;
            plan = Some(plan.map_or(shown.report, |plan| plan.and(shown.report)));
            for (view, shown) in self.output.iter().zip(shown.pictures) {
                let path = file(*seed, *view);
                picture::write(&path, &shown)?;
                files.push(path);
                sheet = sheet.push(shown, format!("{seed}"));
            }
            bar.inc(1);
        }
        sheet.save(&grid)?;
        bar.finish_and_clear();
        let report = Report { files, grid, seconds: began.elapsed().as_secs_f64(), plan };
        console.result(&report, || {
            format!("{}: {} pictures in {:.1} s", report.grid.display(), report.files.len(), report.seconds)
        })?;
        Ok(Outcome::Done)
    }
}

fn truncation(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(psi) if (-2.0..=2.0).contains(&psi) => Ok(psi),
        _ => Err("must be a number between -2 and 2".into()),
    }
}
