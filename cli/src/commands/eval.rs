//! `cnerf eval`: numbers against held-out data.

mod consistency;
mod inversion;
mod locality;
mod parser;
mod quality;

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use cnerf_core::{
    data::dataset::Dataset,
    eval::{realism::camera_like, subject::Subject},
    model::generator::Generator,
};
use cnerf_invert::inverter::Opened;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions},
    portraits,
};

/// What is measured.
#[derive(Subcommand, Debug)]
pub enum EvalCommand {
    /// How like photos random portraits are: FID, KID, precision, recall, sharpness, regions
    Quality(quality::QualityArguments),
    /// How well held-out photos are inverted
    Inversion(Box<inversion::InversionArguments>),
    /// Whether the views of a portrait agree
    Consistency(consistency::ConsistencyArguments),
    /// Whether edits stay in their region
    Locality(locality::LocalityArguments),
    /// How well a face parser finds regions and head pose
    Parser(parser::ParserArguments),
}

impl EvalCommand {
    /// Measures and reports.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        match self {
            Self::Quality(quality) => quality.run(seed, console),
            Self::Inversion(inversion) => inversion.run(seed, console),
            Self::Consistency(consistency) => consistency.run(seed, console),
            Self::Locality(locality) => locality.run(seed, console),
            Self::Parser(parser) => parser.run(console),
        }
    }
}

/// Where charts go.
#[derive(Args, Debug)]
struct PlotOptions {
    /// Folder to write charts to, as SVG
    #[arg(long, value_name = "DIR")]
    plots: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

impl PlotOptions {
    /// Refuses, before anything is computed, charts that exist and may not be replaced.
    fn check(&self, names: &[&str]) -> anyhow::Result<()> {
        names.iter().filter_map(|name| self.path(name)).try_for_each(|path| self.overwrite.check(&path))
    }

    /// Where the chart `name` goes, if charts are wanted.
    fn path(&self, name: &str) -> Option<PathBuf> {
        Some(self.plots.as_ref()?.join(name).with_extension("svg"))
    }
}

/// Which portraits are measured.
#[derive(Args, Debug)]
struct PortraitOptions {
    /// Portrait files to measure in place of random portraits
    #[arg(value_name = "PORTRAIT")]
    portraits: Vec<PathBuf>,
    /// Dataset whose cameras random portraits are seen from
    #[arg(long, value_name = "PATH", conflicts_with = "portraits")]
    data: Option<PathBuf>,
    /// Random portraits to measure: those of `generate --seeds SEED…`
    #[arg(long, default_value_t = 8, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000))]
    count: u32,
    /// Truncation of random portraits: 1 draws from all, 0 gives the mean portrait
    #[arg(long, default_value_t = 0.7, value_name = "PSI", value_parser = truncation, allow_negative_numbers = true)]
    trunc: f64,
    #[command(flatten)]
    model: ModelOptions,
}

/// The portraits that [`PortraitOptions`] name, opened one at a time.
struct Portraits {
    files: Vec<PathBuf>,
    dataset: Option<Dataset>,
    generator: Option<Generator>,
    count: usize,
    truncation: f64,
    seed: u64,
    model: ModelOptions,
}

impl PortraitOptions {
    fn open(self, seed: u64) -> anyhow::Result<Portraits> {
        let dataset = self.data.map(Dataset::open).transpose()?;
        let generator = if self.portraits.is_empty() { Some(self.model.load_or("portrait")?) } else { None };
        let count = if self.portraits.is_empty() { self.count as usize } else { self.portraits.len() };
        let (files, truncation, model) = (self.portraits, self.trunc, self.model);
        Ok(Portraits { files, dataset, generator, count, truncation, seed, model })
    }
}

impl Portraits {
    fn len(&self) -> usize {
        self.count
    }

    /// What is measured, in words.
    fn described(&self) -> String {
        let model = self.model.model.as_deref().unwrap_or("portrait");
        match &self.generator {
            Some(_) => format!("{} random portraits of `{model}`, truncation {}", self.count, self.truncation),
            None => format!("{} portrait files", self.count),
        }
    }

    /// Calls `measure` with portrait `index`, its name and codes to swap in: those of another random portrait.
    fn visit<T>(
        &self,
        index: usize,
        measure: impl FnOnce(&Subject<'_>, &candle_core::Tensor) -> anyhow::Result<T>,
    ) -> anyhow::Result<(String, T)> {
        let seed = self.seed.wrapping_add(index as u64);
        let donor = self.seed.wrapping_add((self.count + index) as u64);
        match (&self.generator, self.files.get(index)) {
            (Some(generator), _) => {
                let camera = match &self.dataset {
                    Some(dataset) => camera_like(dataset, self.seed, index)?,
                    None => cnerf_core::camera::Camera::default(),
                };
                let subject = Subject::random(generator, seed, self.truncation, camera)?;
                let donor = generator.codes_from_seed(donor, self.truncation)?.detach();
                Ok((format!("seed {seed}"), measure(&subject, &donor)?))
            }
            (None, Some(path)) => {
                let Opened { generator, codes, global, camera, .. } = portraits::open(path, &self.model)?;
                let donor = generator.codes_from_seed(donor, self.truncation)?.detach();
                let subject = Subject { generator: &generator, codes, global, camera };
                Ok((path.display().to_string(), measure(&subject, &donor)?))
            }
            (None, None) => anyhow::bail!("there is no portrait {index}"),
        }
    }
}

fn truncation(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(psi) if (0.0..=2.0).contains(&psi) => Ok(psi),
        _ => Err("must be between 0 and 2".into()),
    }
}

/// Lines of a table: what, and its value.
fn table(rows: &[(&str, String)]) -> String {
    let width = rows.iter().map(|(name, _)| name.chars().count()).max().unwrap_or(0);
    rows.iter().map(|(name, value)| format!("{name:<width$}  {value}")).collect::<Vec<_>>().join("\n")
}

/// A number with `digits` decimals; a dash for none.
fn shown(value: impl Into<Option<f64>>, digits: usize) -> String {
    value.into().map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"))
}

/// The name of a model for reports.
fn model_name(model: &ModelOptions) -> &str {
    model.model.as_deref().unwrap_or("portrait")
}

/// Whether `path` names a run that left its training portraits' codes beside the model.
fn has_codes(path: &Path) -> bool {
    path.is_file() && path.with_file_name("codes.safetensors").is_file()
}
