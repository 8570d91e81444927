//! `cnerf dataset`: check, align and import.

use std::path::{Path, PathBuf};

use anyhow::bail;
use clap::{Args, Subcommand};
use cnerf_core::{
    data::{
        dataset::{Dataset, DatasetWriter, EncodedItem, PhotoFormat},
        import::{ImportConfig, import},
    },
    region::Region,
};
use cnerf_invert::photo::{PhotoOptions, Subject};
use serde::Serialize;
use serde_json::json;

use crate::{
    console::{Console, Outcome},
    options::OverwriteOptions,
};

/// What to do with a dataset.
#[derive(Subcommand, Debug)]
pub enum DatasetCommand {
    /// Read every file and name those that are wrong
    Check(CheckArguments),
    /// Find faces in raw photos and cut square portraits
    Align(AlignArguments),
    /// Read CelebAMask-HQ, FFHQ with masks, or the authors' .npy masks
    Import(ImportArguments),
}

/// Arguments of `cnerf dataset check`.
#[derive(Args, Debug)]
pub struct CheckArguments {
    /// Dataset: a folder or a zip
    path: PathBuf,
}

/// Arguments of `cnerf dataset align`.
#[derive(Args, Debug)]
pub struct AlignArguments {
    /// Photos
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    /// Dataset to write: a folder, or a zip by its name
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// Width and height of the portraits, pixels
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(16..=2048))]
    size: u32,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

/// Arguments of `cnerf dataset import`.
#[derive(Args, Debug)]
pub struct ImportArguments {
    #[command(flatten)]
    config: ImportConfig,
    /// Dataset to write: a folder, or a zip by its name
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Serialize)]
struct Failure {
    input: PathBuf,
    error: String,
}

impl DatasetCommand {
    /// Runs it.
    pub fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        match self {
            Self::Check(arguments) => arguments.run(console),
            Self::Align(arguments) => arguments.run(console),
            Self::Import(arguments) => arguments.run(console),
        }
    }
}

impl CheckArguments {
    fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        let dataset = Dataset::open(&self.path)?;
        let bar = console.bar(dataset.len() as u64, "check");
        let report = dataset.check(&|done| bar.set_position(done as u64));
        bar.finish_and_clear();
        let shares: serde_json::Map<_, _> = Region::ALL
            .iter()
            .map(|region| (region.name().into(), json!(report.region_share[region.index()])))
            .collect();
        let problems: Vec<_> = report
            .problems
            .iter()
            .map(|problem| json!({"item": problem.index, "error": problem.error.to_string()}))
            .collect();
        let value = json!({
            "items": report.items, "with_mask": report.with_mask, "with_camera": report.with_camera,
            "resolutions": report.resolutions, "region_share": shares, "problems": problems,
        });
        console.result(&value, || {
            let mut lines: Vec<String> =
                report.problems.iter().map(|problem| format!("bad: {}", problem.error)).collect();
            lines.push(format!(
                "{}: {} items, {} with masks, {} with cameras, {} bad",
                self.path.display(),
                report.items,
                report.with_mask,
                report.with_camera,
                report.problems.len()
            ));
            lines.join("\n")
        })?;
        match report.problems.len() {
            0 => Ok(Outcome::Done),
            bad if bad < report.items => Ok(Outcome::Partial),
            _ => bail!("{}: no item can be used", self.path.display()),
        }
    }
}

impl AlignArguments {
    fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        self.overwrite.check(&self.out)?;
        let mut writer = DatasetWriter::create(&self.out, self.overwrite.overwrite)?;
        let bar = console.bar(self.photos.len() as u64, "align");
        let mut failed = Vec::new();
        for photo in &self.photos {
            if let Err(error) = align(photo, self.size, &mut writer, console) {
                bar.suspend(|| console.warn(format!("{error:#}")));
                failed.push(Failure { input: photo.clone(), error: format!("{error:#}") });
            }
            bar.inc(1);
        }
        bar.finish_and_clear();
        if writer.is_empty() {
            bail!("none of {} photos could be aligned", self.photos.len());
        }
        let aligned = writer.len();
        writer.finish()?;
        let partial = !failed.is_empty();
        console.result(&json!({"output": self.out, "aligned": aligned, "failed": failed}), || {
            format!("{}: {aligned} of {} photos aligned", self.out.display(), self.photos.len())
        })?;
        Ok(if partial { Outcome::Partial } else { Outcome::Done })
    }
}

fn align(photo: &Path, size: u32, writer: &mut DatasetWriter, console: &Console) -> anyhow::Result<()> {
    let subject = Subject::read(photo, &PhotoOptions::default(), None, size)?;
    subject.warnings.iter().for_each(|warning| console.warn(warning));
    let aligned = &subject.aligned;
    let item = EncodedItem::new(&aligned.picture, None, Some(aligned.camera), PhotoFormat::Jpeg(95))?
        .with("source", subject.source)
        .with("padded", aligned.padded);
    Ok(writer.add(item)?)
}

impl ImportArguments {
    fn run(self, console: &Console) -> anyhow::Result<Outcome> {
        self.overwrite.check(&self.out)?;
        let mut writer = DatasetWriter::create(&self.out, self.overwrite.overwrite)?;
        let bar = console.bar(0, "import");
        let report = import(&self.config, &mut writer, &|done, total| {
            bar.set_length(total as u64);
            bar.set_position(done as u64);
        })?;
        writer.finish()?;
        bar.finish_and_clear();
        report.failed.iter().for_each(|error| console.warn(error));
        let failed: Vec<String> = report.failed.iter().map(ToString::to_string).collect();
        let partial = !failed.is_empty();
        console.result(&json!({"output": self.out, "written": report.written, "failed": failed}), || {
            format!("{}: {} portraits, {} left out", self.out.display(), report.written, report.failed.len())
        })?;
        Ok(if partial { Outcome::Partial } else { Outcome::Done })
    }
}
