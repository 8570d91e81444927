//! `cnerf render`: multi-view sequences of a portrait, of a random one, or of several blended one into the next, and
//! pages to turn a portrait on.

use std::path::{Path, PathBuf};

use anyhow::bail;
use candle_core::Tensor;
use clap::Args;
use cnerf_core::{
    camera::Camera,
    interop::{
        animation::{self, Format},
        page::{Grid, Page},
    },
    model::generator::Generator,
    region::RegionSet,
    render::{
        plan::{FrameReport, Sequence},
        trajectory::Trajectory,
    },
};
use cnerf_invert::{inverter::Opened, portrait::Portrait};
use image::RgbImage;
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions, stem},
    portraits,
    views::{Scene, Stereo, View, side_by_side},
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
    #[arg(long, value_name = "PATH", required_unless_present = "html")]
    out: Option<PathBuf>,
    /// Write one page with everything in it, to turn the head with the mouse and show regions and layers
    #[arg(long, value_name = "FILE.html", conflicts_with_all = ["out", "trajectory", "frames", "stereo", "output"])]
    html: Option<PathBuf>,
    /// Views of the page, across and up
    #[arg(long, value_name = "XxY", default_value = "15x5", value_parser = grid)]
    grid: [usize; 2],
    /// Render for two eyes
    #[arg(long, value_enum, value_name = "KIND")]
    stereo: Option<Stereo>,
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

/// How far a page's views reach, radians: a little beyond what the models have seen.
const PAGE_AZIMUTH_RAD: f64 = 0.6;
const PAGE_ELEVATION_RAD: f64 = 0.25;

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    frames: usize,
    width: u32,
    height: u32,
    seconds: f64,
    /// Of all frames together.
    plan: Option<FrameReport>,
}

/// One end of a blend.
struct Key {
    /// The portrait's file and its model's hash: what may be blended with it.
    named: Option<(PathBuf, String)>,
    generator: Generator,
    codes: Tensor,
    global: Option<Tensor>,
}

impl RenderArguments {
    /// Renders the frames and writes them.
    pub fn run(self, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        if let Some(path) = &self.html {
            return self.page(path, seed, console);
        }
        let Some(out) = self.out.clone() else { bail!("--out: say where to write") };
        // A folder in the way of a file is told when it is written; an existing folder of frames needs --overwrite.
        if Format::of(&out)? == Format::Folder || !out.is_dir() {
            self.overwrite.check(&out)?;
        }
        if self.output.is_empty() {
            bail!("--output: name at least one of rgb, seg, depth, normal");
        }
        let began = std::time::Instant::now();
        let cameras = self.trajectory.cameras(self.frames)?;
        let keys = self.keys(seed)?;
        let sequence = match keys.as_slice() {
            [key] => {
                let eyes: Vec<Camera> = match self.stereo {
                    Some(_) => cameras.iter().flat_map(Stereo::cameras).collect(),
                    None => cameras.clone(),
                };
                key.scene(self.regions).sequence(&eyes, self.output.contains(&View::Normal))?
            }
            _ => None,
        };
        let mut plan: Option<FrameReport> = None;
        let bar = console.bar(cameras.len() as u64, "render");
        let mut frames = Vec::with_capacity(cameras.len());
        for (index, camera) in cameras.iter().enumerate() {
            let (frame, report) = self.frame(&keys, index, cameras.len(), camera, sequence.as_ref())?;
            plan = Some(plan.map_or(report, |plan| plan.and(report)));
            frames.push(frame);
            bar.inc(1);
        }
        bar.finish_and_clear();
        animation::save(&frames, self.fps, &out)?;
        let (width, height) = frames.first().map_or((0, 0), RgbImage::dimensions);
        let seconds = began.elapsed().as_secs_f64();
        let report = Report { output: out, frames: frames.len(), width, height, seconds, plan };
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

    /// Renders the grid of views and writes the page.
    fn page(&self, path: &Path, seed: Option<u64>, console: &Console) -> anyhow::Result<Outcome> {
        if !path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("html")) {
            bail!("{}: name the page .html", path.display());
        }
        self.overwrite.check(path)?;
        let began = std::time::Instant::now();
        let [columns, rows] = self.grid;
        let grid = Grid::even(columns, rows, PAGE_AZIMUTH_RAD, PAGE_ELEVATION_RAD)?;
        let keys = self.keys(seed)?;
        let [key] = keys.as_slice() else { bail!("--html shows one portrait; {} are named", keys.len()) };
        let scene = key.scene(self.regions);
        let cameras = grid.cameras();
        let sequence = scene.sequence(&cameras, true)?;
        let mut plan: Option<FrameReport> = None;
        let bar = console.bar(cameras.len() as u64, "page");
        let mut frames = Vec::with_capacity(cameras.len());
        for camera in &cameras {
            let (frame, report) = scene.page_frame(camera, sequence.as_ref())?;
            plan = Some(plan.map_or(report, |plan| plan.and(report)));
            frames.push(frame);
            bar.inc(1);
        }
        bar.finish_and_clear();
        let title = match (self.portraits.first(), seed) {
            (Some(portrait), _) => stem(portrait),
            (None, seed) => format!("seed {}", seed.unwrap_or_default()),
        };
        let side = frames.first().map_or(0, |frame| frame.portrait.width());
        Page { title, grid, frames }.save(path)?;
        let report = Report {
            output: path.to_owned(),
            frames: cameras.len(),
            width: side,
            height: side,
            seconds: began.elapsed().as_secs_f64(),
            plan,
        };
        console.result(&report, || {
            let bytes = std::fs::metadata(path).map_or(0, |metadata| metadata.len());
            let megabytes = bytes as f64 / 1e6;
            format!("{}: {} views, {megabytes:.1} MB, in {:.1} s", path.display(), report.frames, report.seconds)
        })?;
        Ok(Outcome::Done)
    }

    fn keys(&self, seed: Option<u64>) -> anyhow::Result<Vec<Key>> {
        if self.portraits.is_empty() {
            let Some(seed) = seed else { bail!("name a portrait file, or pass --seed S for a random portrait") };
            let generator = self.model.load_or("portrait")?;
            let codes = generator.codes_from_seed(seed, self.trunc)?;
            return Ok(vec![Key { named: None, generator, codes, global: None }]);
        }
        if seed.is_some() {
            bail!("--seed renders a random portrait; leave it out where portrait files are named");
        }
        let keys: Vec<Key> = self.portraits.iter().map(|path| self.key(path)).collect::<anyhow::Result<_>>()?;
        for (one, other) in keys.iter().zip(keys.iter().skip(1)) {
            if let (Some((path, hash)), Some((other, found))) = (&one.named, &other.named)
                && hash != found
            {
                let (path, other) = (path.display(), other.display());
                bail!("{path} and {other} belong to different models (hashes {hash} and {found}): they do not blend");
            }
        }
        Ok(keys)
    }

    fn key(&self, path: &Path) -> anyhow::Result<Key> {
        let portrait = Portrait::load(path)?;
        let model = portraits::model_of(&portrait, path, &self.model)?;
        let Opened { generator, codes, global, .. } = Opened::new(&portrait, path, &model)?;
        Ok(Key { named: Some((path.to_owned(), portrait.model.hash)), generator, codes, global })
    }

    /// Frame `index`: between two portraits codes and tuned weights move together.
    fn frame(
        &self,
        keys: &[Key],
        index: usize,
        count: usize,
        camera: &Camera,
        sequence: Option<&Sequence>,
    ) -> anyhow::Result<(RgbImage, FrameReport)> {
        let place = if count > 1 { index as f64 / (count - 1) as f64 * (keys.len() - 1) as f64 } else { 0.0 };
        let left = (place.floor() as usize).min(keys.len().saturating_sub(2));
        let blend = place - left as f64;
        let from = &keys[left];
        let blended = match keys.get(left + 1) {
            Some(to) if blend > 0.0 => Some(mix(from, to, blend)?),
            _ => None,
        };
        let key = blended.as_ref().unwrap_or(from);
        let scene = key.scene(self.regions);
        let Some(stereo) = self.stereo else {
            let shown = scene.pictures(camera, &self.output, sequence)?;
            return Ok((side_by_side(&shown.pictures), shown.report));
        };
        let [left, right] = Stereo::cameras(camera);
        let left = scene.pictures(&left, &self.output, sequence)?;
        let right = scene.pictures(&right, &self.output, sequence)?;
        let pairs = left.pictures.iter().zip(&right.pictures);
        let joined: Vec<RgbImage> = pairs.map(|(left, right)| stereo.join(left, right)).collect();
        Ok((side_by_side(&joined), left.report.and(right.report)))
    }
}

impl Key {
    fn scene(&self, regions: RegionSet) -> Scene<'_> {
        Scene { generator: &self.generator, codes: &self.codes, global: self.global.as_ref(), regions }
    }
}

fn mix(from: &Key, to: &Key, amount: f64) -> anyhow::Result<Key> {
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
    let generator = generator.with_budget(from.generator.render_settings().budget);
    Ok(Key { named: None, generator, codes: between(&from.codes, &to.codes)?, global })
}

fn grid(text: &str) -> Result<[usize; 2], String> {
    let parts: Vec<usize> = text.split('x').map_while(|part| part.trim().parse().ok()).collect();
    match parts.as_slice() {
        [columns, rows] if (2..=63).contains(columns) && (2..=63).contains(rows) => Ok([*columns, *rows]),
        _ => Err("must be views across x views up, 2 to 63 each, e.g. 15x5".into()),
    }
}

fn trajectory(name: &str) -> Result<Trajectory, String> {
    Trajectory::try_from(name.to_owned()).map_err(|error| error.to_string())
}
