//! `cnerf render`: multi-view sequences of a portrait, of a random one, or of several blended one into the next.

use std::path::{Path, PathBuf};

use anyhow::bail;
use candle_core::Tensor;
use clap::Args;
use cnerf_core::{
    camera::Camera,
    interop::animation::{self, Format},
    model::generator::Generator,
    region::RegionSet,
    render::trajectory::Trajectory,
};
use image::RgbImage;
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions},
    portraits,
    views::{Scene, View, side_by_side},
};

/// Arguments of `cnerf render`.
#[derive(Args, Debug)]
pub struct RenderArguments {
    /// Portrait files; several of one model are blended from the first to the last. Without any, --seed is rendered
    portraits: Vec<PathBuf>,
    /// Path of the camera: orbit, sweep, front, or a JSON list of cameras
    #[arg(long, default_value = "orbit", value_name = "NAME|FILE.json", value_parser = trajectory)]
    trajectory: Trajectory,
    /// Number of frames [default: as the trajectory has]
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Frames a second in animations
    #[arg(long, default_value_t = 20.0, value_name = "FPS")]
    fps: f64,
    /// Where to: .gif, .apng, .mp4 (needs ffmpeg), .png (a picture or a sheet), or a folder of frames
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// What to render; several stand side by side
    #[arg(long, value_enum, value_delimiter = ',', default_value = "rgb")]
    output: Vec<View>,
    /// Render only these regions
    #[arg(long, default_value = "all", value_name = "R[,R]")]
    regions: RegionSet,
    /// Truncation of a --seed's portrait
    #[arg(long, default_value_t = 0.7, value_name = "PSI")]
    trunc: f64,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    frames: usize,
    width: u32,
    height: u32,
    seconds: f64,
}

/// One end of a blend.
struct Key {
    generator: Generator,
    codes: Tensor,
    global: Option<Tensor>,
}

impl RenderArguments {
    /// Renders the frames and writes them.
    pub fn run(self, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        let format = Format::of(&self.out)?;
        if format == Format::Folder || !self.out.is_dir() {
            self.overwrite.check(&self.out)?;
        }
        if self.output.is_empty() {
            bail!("--output: name at least one of rgb, seg, depth, normal");
        }
        let began = std::time::Instant::now();
        let cameras = self.trajectory.cameras(self.frames)?;
        let keys = self.keys(seed)?;
        let bar = console.bar(cameras.len() as u64, "render");
        let mut frames = Vec::with_capacity(cameras.len());
        for (index, camera) in cameras.iter().enumerate() {
            frames.push(self.frame(&keys, index, cameras.len(), camera)?);
            bar.inc(1);
        }
        bar.finish_and_clear();
        animation::save(&frames, self.fps, &self.out)?;
        let (width, height) = frames.first().map_or((0, 0), RgbImage::dimensions);
        let report =
            Report { output: self.out, frames: frames.len(), width, height, seconds: began.elapsed().as_secs_f64() };
        console.result(&report, || {
            format!(
                "{}: {} frames of {width}x{height} in {:.1} s",
                report.output.display(),
                report.frames,
                report.seconds
            )
        })?;
        Ok(Outcome::Done)
    }

    fn keys(&self, seed: Option<u64>) -> anyhow::Result<Vec<Key>> {
        if self.portraits.is_empty() {
            let Some(seed) = seed else { bail!("name a portrait file, or pass --seed S for a random portrait") };
            let generator = self.model.load_or("portrait")?;
            let codes = generator.codes_from_seed(seed, self.trunc)?;
            return Ok(vec![Key { generator, codes, global: None }]);
        }
        if seed.is_some() {
            bail!("--seed renders a random portrait; leave it out where portrait files are named");
        }
        self.portraits.iter().map(|path| self.key(path)).collect()
    }

    fn key(&self, path: &Path) -> anyhow::Result<Key> {
        let opened = portraits::open(path, &self.model)?;
        Ok(Key { generator: opened.generator, codes: opened.codes, global: opened.global })
    }

    /// Frame `index`: between two portraits codes and tuned weights move together.
    fn frame(&self, keys: &[Key], index: usize, count: usize, camera: &Camera) -> anyhow::Result<RgbImage> {
        let place = if count > 1 { index as f64 / (count - 1) as f64 * (keys.len() - 1) as f64 } else { 0.0 };
        let left = (place.floor() as usize).min(keys.len().saturating_sub(2));
        let blend = place - left as f64;
        let from = &keys[left];
        let blended = match keys.get(left + 1) {
            Some(to) if blend > 0.0 => Some(mix(from, to, blend)?),
            _ => None,
        };
        let key = blended.as_ref().unwrap_or(from);
        let scene =
            Scene { generator: &key.generator, codes: &key.codes, global: key.global.as_ref(), regions: self.regions };
        Ok(side_by_side(&scene.pictures(camera, &self.output)?))
    }
}

fn mix(from: &Key, to: &Key, amount: f64) -> anyhow::Result<Key> {
    if from.generator.config() != to.generator.config() {
        bail!("the portraits belong to different models and cannot be blended");
    }
    let between = |a: &Tensor, b: &Tensor| -> candle_core::Result<Tensor> { (a * (1.0 - amount))? + (b * amount)? };
    let (start, end) = (from.generator.parameters().snapshot()?, to.generator.parameters().snapshot()?);
    let weights = start
        .iter()
        .map(|(name, value)| match end.get(name) {
            Some(other) => Ok((name.clone(), between(value, other)?)),
            None => Ok((name.clone(), value.clone())),
        })
        .collect::<anyhow::Result<_>>()?;
    let global = match (&from.global, &to.global) {
        (Some(a), Some(b)) => Some(between(a, b)?),
        _ => None,
    };
    let device = from.generator.device();
    let generator = Generator::from_tensors(from.generator.config(), weights, &device)?;
    Ok(Key { generator, codes: between(&from.codes, &to.codes)?, global })
}

fn trajectory(name: &str) -> Result<Trajectory, String> {
    Trajectory::try_from(name.to_owned()).map_err(|error| error.to_string())
}
