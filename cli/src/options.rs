//! Options that several commands share, and how their raw form is resolved.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use candle_core::Device;
use clap::Args;
use cnerf_core::model::generator::Generator;
use cnerf_invert::start::NearStart;

/// Options every command takes.
#[derive(Args, Clone, Debug)]
pub struct GlobalOptions {
    /// Threads to compute with [default: all cores]
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub threads: Option<u16>,
    /// Seed of every random draw; the same seed gives the same bytes
    #[arg(long, global = true, value_name = "S")]
    pub seed: Option<u64>,
    /// Print nothing but errors and the result
    #[arg(long, short, global = true)]
    pub quiet: bool,
    /// Draw no progress bars
    #[arg(long, global = true)]
    pub no_progress: bool,
    /// Print one JSON object on stdout and nothing else there
    #[arg(long, global = true)]
    pub json: bool,
    /// Say more; repeat for even more
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
}

/// Which model, and where it computes.
#[derive(Args, Clone, Debug)]
pub struct ModelSource {
    /// The model: `portrait` and `cartoon` are built in; else a file
    #[arg(long, value_name = "NAME|PATH")]
    pub model: Option<String>,
    /// Where to compute: cpu, cuda, cuda:N or metal
    #[arg(long, default_value = "cpu", value_name = "DEVICE")]
    pub device: String,
}

/// Where a model renders.
#[derive(Args, Clone, Debug)]
pub struct ModelOptions {
    #[command(flatten)]
    source: ModelSource,
    /// Largest allowed error per pixel of renders from leaving out what hardly shows, in [0, 1] colour units; 0 = exact
    #[arg(long, default_value_t = 0.002, value_name = "E", value_parser = budget, allow_negative_numbers = true)]
    budget: f64,
}

impl ModelOptions {
    /// The model asked for, or `default`; its renders keep the budget.
    pub fn load_or(&self, default: &str) -> anyhow::Result<Generator> {
        Ok(self.source.load_or(default)?.with_budget(self.budget))
    }
}

impl std::ops::Deref for ModelOptions {
    type Target = ModelSource;

    fn deref(&self) -> &ModelSource {
        &self.source
    }
}

impl ModelSource {
    /// The model asked for, or `default`.
    pub fn load_or(&self, default: &str) -> anyhow::Result<Generator> {
        let name = self.model.as_deref().unwrap_or(default);
        let (path, device) = (Path::new(name), self.device()?);
        match cnerf_models::bytes(name) {
            Some(bytes) => Ok(Generator::from_bytes(path, bytes, &device)?),
            None if path.exists() => Ok(Generator::open(path, &device)?),
            None => bail!("{name}: no such file, and no built-in model ({})", cnerf_models::NAMES.join(", ")),
        }
    }

    /// The near start of the built-in model asked for, or of `default`; other models have none.
    pub fn near_start(&self, default: &str) -> anyhow::Result<Option<NearStart>> {
        let name = self.model.as_deref().unwrap_or(default);
        Ok(cnerf_models::start(name).map(|bytes| NearStart::from_bytes(Path::new(name), bytes)).transpose()?)
    }

    /// The device asked for.
    pub fn device(&self) -> anyhow::Result<Device> {
        let number =
            |text: &str| text.parse::<usize>().with_context(|| format!("--device {}: not a number", self.device));
        match self.device.split_once(':') {
            None if self.device == "cpu" => Ok(Device::Cpu),
            None if self.device == "cuda" => gpu("cuda", Device::new_cuda(0)),
            Some(("cuda", index)) => gpu("cuda", Device::new_cuda(number(index)?)),
            None if self.device == "metal" => gpu("metal", Device::new_metal(0)),
            _ => bail!("--device {}: unknown; use cpu, cuda, cuda:N or metal", self.device),
        }
    }
}

fn budget(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(budget) if (0.0..=1.0).contains(&budget) => Ok(budget),
        _ => Err("must be a number between 0 (exact) and 1".into()),
    }
}

fn gpu(name: &str, device: candle_core::Result<Device>) -> anyhow::Result<Device> {
    device.with_context(|| {
        format!("--device {name}: not available; build with `--features {name}` on a machine that has it")
    })
}

/// Whether existing outputs may be replaced.
#[derive(Args, Clone, Copy, Debug)]
pub struct OverwriteOptions {
    /// Replace outputs that exist
    #[arg(long)]
    pub overwrite: bool,
}

impl OverwriteOptions {
    /// Refuses `path` if it exists and may not be replaced.
    pub fn check(&self, path: &Path) -> anyhow::Result<()> {
        if !self.overwrite && path.exists() {
            bail!("{}: exists; choose another name or pass --overwrite", path.display());
        }
        Ok(())
    }
}

/// The seeds of `0,4-7`, in the order written.
pub fn parse_seeds(list: &str) -> Result<Vec<u64>, String> {
    const MOST: usize = 100_000;
    let mut seeds = Vec::new();
    for part in list.split(',').map(str::trim) {
        let number =
            |text: &str| text.trim().parse::<u64>().map_err(|_| format!("`{part}` is not a seed or a range of seeds"));
        match part.split_once('-') {
            Some((first, last)) => {
                let (first, last) = (number(first)?, number(last)?);
                if last < first || last - first >= MOST as u64 {
                    return Err(format!("`{part}` is not an ascending range of at most {MOST} seeds"));
                }
                seeds.extend(first..=last);
            }
            None => seeds.push(number(part)?),
        }
        if seeds.len() > MOST {
            return Err(format!("more than {MOST} seeds"));
        }
    }
    Ok(seeds)
}

/// A file's name without its folder and extension.
pub fn stem(path: &Path) -> String {
    path.file_stem().map_or_else(|| "portrait".into(), |stem| stem.to_string_lossy().into_owned())
}

/// `path` with another extension.
pub fn beside(path: &Path, extension: &str) -> PathBuf {
    path.with_extension(extension)
}

#[cfg(test)]
mod tests {
    use super::parse_seeds;

    #[test]
    fn seeds_are_lists_and_ranges() {
        assert_eq!(parse_seeds("0,4-7"), Ok(vec![0, 4, 5, 6, 7]));
        assert!(parse_seeds("7-4").is_err() && parse_seeds("a").is_err() && parse_seeds("0-999999999").is_err());
    }
}
