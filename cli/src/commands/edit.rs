//! `cnerf edit`: change regions of a portrait.

use std::path::PathBuf;

use anyhow::bail;
use clap::Args;
use cnerf_core::{codes::Aspect, data::picture, region::RegionSet};
use cnerf_invert::{
    edit::{self, Change, Edit, Source, source_codes},
    portrait::Portrait,
};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions, beside},
    portraits,
    views::side_by_side,
};

/// Arguments of `cnerf edit`.
#[derive(Args, Debug)]
pub struct EditArguments {
    /// Portrait file
    portrait: PathBuf,
    /// Regions to change; may repeat, each with its own --from in the same order
    #[arg(long, value_name = "R[,R]")]
    region: Vec<RegionSet>,
    /// Change the shape (with neither --shape nor --texture: both)
    #[arg(long)]
    shape: bool,
    /// Change the texture
    #[arg(long)]
    texture: bool,
    /// Take the codes of this portrait; may repeat, one for each --region (else --seed S or --mean)
    #[arg(long, value_name = "PORTRAIT", conflicts_with = "mean")]
    from: Vec<PathBuf>,
    /// Take the codes of the model's mean portrait
    #[arg(long)]
    mean: bool,
    /// How far to go: 0 nothing, 1 all the way; beyond 1 exaggerates
    #[arg(long, default_value_t = 1.0, value_name = "T", allow_negative_numbers = true)]
    amount: f64,
    /// Take back the last edit instead
    #[arg(long, conflicts_with_all = ["region", "shape", "texture", "from", "mean"])]
    undo: bool,
    /// Edited portrait to write; a before/after PNG is written beside it
    #[arg(long, value_name = "FILE.cnerf")]
    out: PathBuf,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    picture: Option<PathBuf>,
    #[serde(flatten)]
    change: Change,
    seconds: f64,
}

impl EditArguments {
    /// Edits, measures, writes.
    pub fn run(self, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        let sheet = beside(&self.out, "png");
        self.overwrite.check(&self.out)?;
        self.overwrite.check(&sheet)?;
        let began = std::time::Instant::now();
        if self.undo {
            return self.undo(began, console);
        }
        let edits = self.edits(seed)?;
        let mut portrait = Portrait::load(&self.portrait)?;
        let model = portraits::model_of(&portrait, &self.portrait, &self.model)?;
        let mut sources = Vec::new();
        for (edit, path) in edits {
            let other = path.map(|path| Portrait::load(path)).transpose()?;
            if let (Some(other), Some(path)) = (&other, path) {
                other.check_model(path, &model.hash()?)?;
            }
            let codes = source_codes(&model, &edit.source, other.as_ref())?;
            sources.push((edit, codes));
        }
        let edited = edit::apply(&mut portrait, &self.portrait, &model, &sources)?;
        portrait.save(&self.out)?;
        picture::write(&sheet, &side_by_side(&[edited.before, edited.after, edited.regions]))?;
        let report = Report {
            output: self.out,
            picture: Some(sheet),
            change: edited.change,
            seconds: began.elapsed().as_secs_f64(),
        };
        console.result(&report, || {
            let Change { inside_change, outside_change, depth_change } = report.change;
            format!(
                "{}: changed {inside_change:.4} inside, {outside_change:.4} outside, depth {depth_change:.6}",
                report.output.display()
            )
        })?;
        Ok(Outcome::Done)
    }

    /// Each edit, and the file its codes come from.
    fn edits(&self, seed: Option<u64>) -> anyhow::Result<Vec<(Edit, Option<&PathBuf>)>> {
        if self.region.is_empty() {
            bail!("--region: name at least one region to change (or pass --undo)");
        }
        let aspect = match (self.shape, self.texture) {
            (true, false) => Aspect::Shape,
            (false, true) => Aspect::Texture,
            _ => Aspect::Both,
        };
        let edit = |regions: RegionSet, source: Source| Edit { regions, aspect, source, amount: self.amount };
        let single = match (self.from.as_slice(), seed, self.mean) {
            ([], Some(seed), false) => Some((Source::Seed(seed), None)),
            ([], None, true) => Some((Source::Mean, None)),
            ([path], None, false) => Some((Source::Portrait(path.display().to_string()), Some(path))),
            ([_, _, ..], None, false) => None,
            ([], None, false) => bail!("say where the new codes come from: --from PORTRAIT, --seed S or --mean"),
            _ => bail!("--from, --seed and --mean exclude each other"),
        };
        if let Some((source, path)) = single {
            return Ok(self.region.iter().map(|regions| (edit(*regions, source.clone()), path)).collect());
        }
        if self.from.len() != self.region.len() {
            bail!("{} --from for {} --region: give one, or one for each region", self.from.len(), self.region.len());
        }
        let pairs = self.region.iter().zip(&self.from);
        Ok(pairs
            .map(|(regions, path)| (edit(*regions, Source::Portrait(path.display().to_string())), Some(path)))
            .collect())
    }

    fn undo(self, began: std::time::Instant, console: &Console) -> anyhow::Result<Outcome> {
        let mut portrait = Portrait::load(&self.portrait)?;
        let record = portrait.undo(&self.portrait)?;
        portrait.save(&self.out)?;
        let report =
            Report { output: self.out, picture: None, change: record.change, seconds: began.elapsed().as_secs_f64() };
        console.result(&report, || {
            format!("{}: took back the {} edit of {}", report.output.display(), record.edit.aspect, record.edit.regions)
        })?;
        Ok(Outcome::Done)
    }
}
