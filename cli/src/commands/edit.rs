//! `cnerf edit`: change regions of a portrait.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use clap::Args;
use cnerf_core::{
    codes::Aspect,
    data::picture,
    interop::sheet::Sheet,
    model::generator::Generator,
    region::{Region, RegionSet},
    render::plan::FrameReport,
};
use cnerf_invert::{
    edit::{self, Change, Colour, Edit, Edited, Goal, Source},
    portrait::Portrait,
};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions, beside},
    portraits,
    views::side_by_side,
};

/// How far a preview sheet goes along each direction, standard deviations.
const PREVIEW_AMOUNTS: [f64; 5] = [-3.0, -1.5, 0.0, 1.5, 3.0];

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
    /// How far to go: 0 nothing, 1 all the way; beyond 1 exaggerates
    #[arg(long, default_value_t = 1.0, value_name = "T", allow_negative_numbers = true)]
    amount: f64,
    #[command(flatten)]
    way: Way,
    /// Edited portrait to write; a before/after PNG is written beside it. With --directions and --mask-write: a PNG
    #[arg(long, value_name = "FILE.cnerf")]
    out: PathBuf,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

/// Where an edit's codes come from; --seed S, which all commands have, is one more.
#[derive(Args, Debug)]
struct Way {
    /// Take the codes of this portrait; may repeat, one for each --region (else --seed S or --mean)
    #[arg(long, value_name = "PORTRAIT", group = "way")]
    from: Vec<PathBuf>,
    /// Take the codes of the model's mean portrait
    #[arg(long, group = "way")]
    mean: bool,
    /// Give a region's texture this mean colour, e.g. hair=#7a3b12; may repeat
    #[arg(long, value_name = "R=#RRGGBB", value_parser = coloured, group = "way", conflicts_with_all = ["region", "shape", "texture"])]
    color: Vec<(Region, Colour)>,
    /// Fit shapes to this region map, one of --mask-write repainted (--region limits which follow)
    #[arg(long, value_name = "FILE.png", group = "way", conflicts_with_all = ["shape", "texture"])]
    mask_paint: Option<PathBuf>,
    /// Move along the regions' principal direction N by --amount standard deviations
    #[arg(long, value_name = "N", group = "way")]
    direction: Option<usize>,
    /// Write a sheet of the regions' first N directions [default: 6] to --out instead
    #[arg(long, value_name = "N", group = "way", num_args = 0..=1, default_missing_value = "6", value_parser = clap::value_parser!(u64).range(1..=64))]
    directions: Option<u64>,
    /// Write the portrait's region map, to be repainted in its colours, to --out instead
    #[arg(long, group = "way", conflicts_with_all = ["region", "shape", "texture"])]
    mask_write: bool,
    /// Take back the last edit instead
    #[arg(long, group = "way", conflicts_with_all = ["region", "shape", "texture"])]
    undo: bool,
}

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    picture: PathBuf,
    #[serde(flatten)]
    change: Change,
    #[serde(skip_serializing_if = "Option::is_none")]
    colour_difference: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rerendered: Option<FrameReport>,
    seconds: f64,
}

/// Files an edit needs beside the portrait.
#[derive(Clone, Copy, Debug, Default)]
struct Files<'a> {
    portrait: Option<&'a Path>,
    map: Option<&'a Path>,
}

impl EditArguments {
    /// Edits, measures, writes.
    pub fn run(self, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        let began = std::time::Instant::now();
        if self.way.mask_write || self.way.directions.is_some() {
            return self.look(seed, console);
        }
        let extension = self.out.extension().unwrap_or_default();
        if extension.eq_ignore_ascii_case("png") {
            bail!("{}: --out names the portrait; its picture is written beside it, as .png", self.out.display());
        }
        let sheet = beside(&self.out, "png");
        self.overwrite.check(&self.out)?;
        self.overwrite.check(&sheet)?;
        if self.way.undo {
            return self.undo(&sheet, began, console);
        }
        let edits = self.edits(seed)?;
        let mut portrait = Portrait::load(&self.portrait)?;
        let model = portraits::model_of(&portrait, &self.portrait, &self.model)?;
        let mut goals = Vec::new();
        for (edit, files) in edits {
            let other = files.portrait.map(Portrait::load).transpose()?;
            if let (Some(other), Some(path)) = (&other, files.portrait) {
                other.check_model(path, &model.hash()?)?;
            }
            let map = files.map.map(edit::read_map).transpose()?;
            let goal = Goal::of(&edit.source, &model, other.as_ref(), map)?;
            goals.push((edit, goal));
        }
        let spinner = console.spinner("editing");
        let edited = edit::apply(&mut portrait, &self.portrait, &model, &goals)?;
        spinner.finish_and_clear();
        self.report(&portrait, edited, &sheet, began, console, |report| {
            let Change { inside_change, outside_change, depth_change } = report.change;
            let colour = report.colour_difference.map(|difference| format!(", {difference:.1} ΔE from the colour"));
            let colour = colour.unwrap_or_default();
            format!("changed {inside_change:.4} inside, {outside_change:.4} outside, depth {depth_change:.6}{colour}")
        })
    }

    /// Writes the portrait and its picture and reports.
    fn report(
        &self,
        portrait: &Portrait,
        edited: Edited,
        sheet: &Path,
        began: std::time::Instant,
        console: &Console,
        say: impl FnOnce(&Report) -> String,
    ) -> anyhow::Result<Outcome> {
        portrait.save(&self.out)?;
        picture::write(sheet, &side_by_side(&[edited.before, edited.after, edited.regions]))?;
        let report = Report {
            output: self.out.clone(),
            picture: sheet.to_owned(),
            change: edited.change,
            colour_difference: edited.colour_difference,
            rerendered: edited.rerendered,
            seconds: began.elapsed().as_secs_f64(),
        };
        console.result(&report, || format!("{}: {}", report.output.display(), say(&report)))?;
        Ok(Outcome::Done)
    }

    fn aspect(&self) -> Aspect {
        match (self.shape, self.texture) {
            (true, false) => Aspect::Shape,
            (false, true) => Aspect::Texture,
            _ => Aspect::Both,
        }
    }

    /// Each edit, and the files its codes come from.
    fn edits(&self, seed: Option<u64>) -> anyhow::Result<Vec<(Edit, Files<'_>)>> {
        let way = &self.way;
        if seed.is_some()
            && (way.mean
                || !way.from.is_empty()
                || !way.color.is_empty()
                || way.mask_paint.is_some()
                || way.direction.is_some())
        {
            bail!("--seed takes a random portrait's codes; leave it out where another source is named");
        }
        if !way.color.is_empty() {
            let edit = |(region, colour): &(Region, Colour)| Edit {
                regions: (*region).into(),
                aspect: Aspect::Texture,
                source: Source::Colour(*colour),
                amount: self.amount,
            };
            return Ok(way.color.iter().map(|one| (edit(one), Files::default())).collect());
        }
        if let Some(path) = &way.mask_paint {
            let regions = self.region.iter().fold(RegionSet::EMPTY, |all, regions| all.union(*regions));
            let source = Source::Painted(path.display().to_string());
            let edit = Edit { regions, aspect: Aspect::Shape, source, amount: self.amount };
            return Ok(vec![(edit, Files { map: Some(path), ..Files::default() })]);
        }
        if self.region.is_empty() {
            bail!("--region: name at least one region to change (or pass --color, --mask-paint or --undo)");
        }
        let aspect = self.aspect();
        let edit = |regions: RegionSet, source: Source| Edit { regions, aspect, source, amount: self.amount };
        let from = |path: &Path| Source::Portrait(path.display().to_string());
        let (source, portrait) = match (way.from.as_slice(), seed, way.direction) {
            ([], Some(seed), _) => (Source::Seed(seed), None),
            ([], _, Some(number)) => (Source::Direction(number), None),
            ([path], ..) => (from(path), Some(path.as_path())),
            ([], ..) if way.mean => (Source::Mean, None),
            ([], ..) => bail!("say where the new codes come from: --from PORTRAIT, --seed S, --mean or --direction N"),
            (paths, ..) => {
                let (sources, regions) = (paths.len(), self.region.len());
                if sources != regions {
                    bail!("{sources} --from for {regions} --region: give one, or one for each region");
                }
                let pairs = self.region.iter().zip(paths);
                let files = |path| Files { portrait: Some(path), ..Files::default() };
                return Ok(pairs.map(|(regions, path)| (edit(*regions, from(path)), files(path))).collect());
            }
        };
        let files = Files { portrait, ..Files::default() };
        Ok(self.region.iter().map(|regions| (edit(*regions, source.clone()), files)).collect())
    }

    fn undo(&self, sheet: &Path, began: std::time::Instant, console: &Console) -> anyhow::Result<Outcome> {
        let (mut portrait, model) = self.open()?;
        let (record, edited) = edit::undo(&mut portrait, &self.portrait, &model)?;
        self.report(&portrait, edited, sheet, began, console, |_| {
            format!("took back the {} edit of {}", record.edit.aspect, record.edit.regions)
        })
    }

    fn open(&self) -> anyhow::Result<(Portrait, Generator)> {
        let portrait = Portrait::load(&self.portrait)?;
        let model = portraits::model_of(&portrait, &self.portrait, &self.model)?;
        Ok((portrait, model))
    }

    /// Writes a picture to decide by: the regions' directions, or the map to repaint.
    fn look(&self, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        if seed.is_some() {
            bail!("--seed makes an edit; leave it out with --directions and --mask-write");
        }
        if !self.out.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
            bail!("{}: a picture is written; name it .png", self.out.display());
        }
        self.overwrite.check(&self.out)?;
        if let Some(count) = self.way.directions {
            let [regions] = self.region.as_slice() else {
                bail!("--directions: name the regions by one --region");
            };
            let (portrait, model) = self.open()?;
            let spinner = console.spinner("rendering directions");
            let whose = (*regions, self.aspect());
            let rows = edit::preview(&portrait, &self.portrait, &model, whose, count as usize, &PREVIEW_AMOUNTS)?;
            let mut sheet = Sheet::new(PREVIEW_AMOUNTS.len());
            for (row, pictures) in rows.into_iter().enumerate() {
                for (picture, amount) in pictures.into_iter().zip(PREVIEW_AMOUNTS) {
                    sheet = sheet.push(picture, format!("{}: {amount:+}", row + 1));
                }
            }
            sheet.save(&self.out)?;
            spinner.finish_and_clear();
        } else {
            let (portrait, model) = self.open()?;
            picture::write(&self.out, &edit::own_map(&portrait, &self.portrait, &model)?.colours())?;
        }
        let report = serde_json::json!({ "output": self.out });
        console.result(&report, || format!("{} written", self.out.display()))?;
        Ok(Outcome::Done)
    }
}

fn coloured(text: &str) -> anyhow::Result<(Region, Colour)> {
    let (region, colour) = text.split_once('=').context("write a region and its colour as hair=#7a3b12")?;
    Ok((region.trim().parse::<Region>()?, colour.trim().parse::<Colour>()?))
}
