//! `cnerf eval parser`: how well regions and head pose are found in portraits that name both.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use cnerf_core::{
    data::{dataset::Dataset, labels::LabelMap, picture},
    interop::sheet::Sheet,
    region::Region,
};
use cnerf_invert::{
    evaluation::parsing::{ParsingScore, PoseError, score_parser},
    parser::ParserConfig,
};
use image::RgbImage;

use super::shown;
use crate::{
    console::{Console, Outcome},
    options::OverwriteOptions,
};

/// Columns of the sheet: each portrait takes three pictures.
const SHEET_COLUMNS: usize = 12;
/// How much of the region's colour lies over the portrait.
const TINT: f32 = 0.55;

/// Arguments of `cnerf eval parser`.
#[derive(Args, Debug)]
pub struct ParserArguments {
    /// Held-out aligned portraits with label maps: a dataset folder or zip
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Portraits to parse
    #[arg(long, default_value_t = 100, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    count: u32,
    #[command(flatten)]
    parser: ParserConfig,
    /// Picture to write: each portrait, the regions it has and the regions found
    #[arg(long, value_name = "FILE.png")]
    sheet: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

impl ParserArguments {
    /// Parses every portrait, measures, reports.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        if let Some(path) = &self.sheet {
            self.overwrite.check(path)?;
        }
        let dataset = Dataset::open(&self.data)?;
        let Some(parser) = self.parser.load(cnerf_models::parser())? else {
            bail!("--parser none: there is nothing to measure; leave it out for the built-in parser");
        };
        let bar = console.bar(dataset.len().min(self.count as usize) as u64, "parser");
        let mut sheet = Some(Sheet::new(SHEET_COLUMNS));
        let score = score_parser(parser.as_ref(), &dataset, self.count as usize, &mut |portrait, known, found| {
            let painted = sheet.take().map(|sheet| sheet.push(portrait.clone(), ""));
            sheet = painted.map(|sheet| sheet.push(tinted(portrait, known), "").push(tinted(portrait, found), ""));
            bar.inc(1);
        })?;
        bar.finish_and_clear();
        if score.count == 0 {
            bail!("{}: no item has a label map; `cnerf dataset check` lists what there is", self.data.display());
        }
        if let (Some(path), Some(sheet)) = (&self.sheet, sheet) {
            picture::write(path, &sheet.render()?)?;
        }
        console.result(&score, || summary(&score))?;
        Ok(Outcome::Done)
    }
}

/// A portrait with its regions' colours laid over it.
fn tinted(portrait: &RgbImage, labels: &LabelMap) -> RgbImage {
    let mut colours = labels.colours();
    for (tint, pixel) in colours.pixels_mut().zip(portrait.pixels()) {
        for (tint, value) in tint.0.iter_mut().zip(pixel.0) {
            *tint = (TINT * f32::from(*tint) + (1.0 - TINT) * f32::from(value)) as u8;
        }
    }
    colours
}

fn summary(score: &ParsingScore) -> String {
    let mut lines =
        vec![format!("{} portraits, mean IoU {}, {:.3} s each", score.count, shown(score.mean_iou, 3), score.seconds)];
    let regions = Region::ALL.iter().map(|region| format!("{} {}", region.name(), shown(score.iou[region.index()], 3)));
    lines.push(regions.collect::<Vec<_>>().join("  "));
    for (who, pose) in [("parser", score.pose), ("alignment", score.alignment_pose)] {
        if let Some(PoseError { azimuth_rad, elevation_rad, roll_rad, direction_rad }) = pose {
            lines.push(format!(
                "pose by {who}: azimuth {azimuth_rad:.3}  elevation {elevation_rad:.3}  roll {roll_rad:.3}  \
                 direction {direction_rad:.3} rad off"
            ));
        }
    }
    lines.join("\n")
}
