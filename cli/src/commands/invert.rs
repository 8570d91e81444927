//! `cnerf invert`: photos to portrait files. Listens to the inverter and draws its progress.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use clap::Args;
use cnerf_core::{data::picture, eval::perceptual::Perceptual, model::generator::Generator};
use cnerf_invert::{
    config::InvertConfig,
    events::Event,
    inverter::{Inversion, Inverter, estimate_seconds},
    parser::{ParserConfig, RegionParser},
    photo::{PhotoOptions, Subject},
};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::{ModelOptions, OverwriteOptions, stem},
    views::side_by_side,
};

/// Arguments of `cnerf invert`.
#[derive(Args, Debug)]
pub struct InvertArguments {
    /// Photos
    #[arg(required = true)]
    photos: Vec<PathBuf>,
    /// Folder for NAME.cnerf (the portrait) and NAME.png (photo, pivot, tuned, regions, depth, two views)
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    #[command(flatten)]
    config: InvertConfig,
    /// Label map of the photo's regions (8-bit PNG, `cnerf-9`)
    #[arg(long, value_name = "FILE")]
    mask: Option<PathBuf>,
    #[command(flatten)]
    parser: ParserConfig,
    /// The head's azimuth and elevation, radians, if known
    #[arg(long, value_name = "A,E", value_parser = pose, allow_hyphen_values = true)]
    pose: Option<[f64; 2]>,
    /// Which face, the largest is 0
    #[arg(long, default_value_t = 0, value_name = "N")]
    face: usize,
    /// The photos are framed like the training portraits already
    #[arg(long)]
    aligned: bool,
    /// LPIPS weights (AlexNet or VGG16, safetensors) for a perceptual loss
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

/// What all photos are inverted with.
#[derive(Clone, Copy)]
struct Tools<'a> {
    generator: &'a Generator,
    perceptual: Option<&'a Perceptual>,
    parser: Option<&'a dyn RegionParser>,
}

#[derive(Default, Serialize)]
struct Report {
    portraits: Vec<Inverted>,
    failed: Vec<Failed>,
}

#[derive(Serialize)]
struct Inverted {
    input: PathBuf,
    output: PathBuf,
    seconds: f64,
    psnr: f64,
    ms_ssim: f64,
    lpips: Option<f64>,
    mask_miou: Option<f64>,
    azimuth: f64,
    elevation: f64,
    depth_drift: f64,
    steps_pivot: usize,
    steps_tune: usize,
}

#[derive(Serialize)]
struct Failed {
    input: PathBuf,
    error: String,
}

impl InvertArguments {
    /// Inverts every photo in order.
    pub fn run(mut self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.config.seed = seed;
        self.config.validate()?;
        if self.photos.len() > 1 && (self.mask.is_some() || self.pose.is_some()) {
            bail!("--mask and --pose belong to one photo; invert photos that need them one by one");
        }
        for (index, photo) in self.photos.iter().enumerate() {
            let output = self.output(photo);
            self.overwrite.check(&output)?;
            if let Some(other) = self.photos.iter().take(index).find(|other| self.output(other) == output) {
                let (photo, other, output) = (photo.display(), other.display(), output.display());
                bail!("{photo} and {other} would both become {output}: rename one, or invert them apart");
            }
        }
        let generator = self.model.load_or("portrait")?;
        let perceptual = self.lpips.as_ref().map(|path| Perceptual::load(path, &generator.device())).transpose()?;
        let parser = self.parser.load()?;
        let tools = Tools { generator: &generator, perceptual: perceptual.as_ref(), parser: parser.as_deref() };
        if !console.is_quiet() {
            let seconds = estimate_seconds(&generator, &self.config, tools.perceptual)?;
            let (effort, count) = (self.config.effort.name(), self.photos.len());
            let photos = if count == 1 { "the photo".to_owned() } else { format!("each of {count} photos") };
            console.note(format_args!("{effort} effort: about {} for {photos}", duration(seconds)));
        }
        let mut report = Report::default();
        for photo in &self.photos {
            match self.invert(photo, &tools, console) {
                Ok(inverted) => {
                    let Inverted { output, psnr, seconds, .. } = &inverted;
                    console.note(format_args!("{}: {psnr:.1} dB in {seconds:.0} s", output.display()));
                    report.portraits.push(inverted);
                }
                Err(error) => {
                    if self.photos.len() > 1 {
                        console.error(&error);
                    }
                    report.failed.push(Failed { input: photo.clone(), error: format!("{error:#}") });
                }
            }
        }
        if report.portraits.is_empty() {
            if let [only] = report.failed.as_slice() {
                bail!("{}", only.error);
            }
            bail!("none of {} photos could be inverted", self.photos.len());
        }
        let partial = !report.failed.is_empty();
        console.result(&report, || {
            let lines = report.portraits.iter().map(|one| {
                format!(
                    "{}  {:.1} dB  azimuth {:+.2}  elevation {:+.2}",
                    one.output.display(),
                    one.psnr,
                    one.azimuth,
                    one.elevation
                )
            });
            lines.collect::<Vec<_>>().join("\n")
        })?;
        Ok(if partial { Outcome::Partial } else { Outcome::Done })
    }

    fn output(&self, photo: &Path) -> PathBuf {
        self.out.join(stem(photo)).with_extension("cnerf")
    }

    fn invert(&self, photo: &Path, tools: &Tools<'_>, console: &Console) -> anyhow::Result<Inverted> {
        let Tools { generator, perceptual, parser } = *tools;
        let began = std::time::Instant::now();
        let options = PhotoOptions { face: self.face, aligned: self.aligned, pose: self.pose, mask: self.mask.clone() };
        let subject = Subject::read(photo, &options, parser, generator.output_resolution() as u32)?;
        if let Some(seconds) = subject.parser_seconds {
            console.note(format_args!("{}: regions parsed in {seconds:.1} s", photo.display()));
        }
        let model_name = self.model.model.as_deref().unwrap_or("portrait");
        let mut inverter = Inverter::new(generator, model_name, subject, self.config.clone(), perceptual)?;
        let mut bar = console.bar(0, "pivot");
        let mut tuning = false;
        while let Some(event) = inverter.step().with_context(|| photo.display().to_string())? {
            match event {
                Event::Pivot(step) | Event::Tune(step) => {
                    if !tuning && matches!(event, Event::Tune(_)) {
                        bar.finish_and_clear();
                        bar = console.bar(0, "tune");
                        tuning = true;
                    }
                    bar.set_length(step.total as u64);
                    bar.set_position(step.step as u64);
                    bar.set_message(format!("loss {:.4}  {:.1} dB", step.loss, step.psnr));
                }
                Event::Settled { step } => bar.set_message(format!("settled after {step} steps")),
                Event::Warning(text) => bar.suspend(|| console.warn(text)),
            }
        }
        let Inversion { portrait, panels } = inverter.finish()?;
        bar.finish_and_clear();
        let output = self.output(photo);
        let [left, right] = panels.novel;
        let strip = [panels.photo, panels.pivot, panels.tuned, panels.regions, panels.depth, left, right];
        portrait.save(&output)?;
        picture::write(&output.with_extension("png"), &side_by_side(&strip))?;
        let (metrics, camera) = (portrait.metrics, portrait.camera);
        Ok(Inverted {
            input: photo.to_owned(),
            output,
            seconds: began.elapsed().as_secs_f64(),
            psnr: metrics.psnr,
            ms_ssim: metrics.ms_ssim,
            lpips: metrics.lpips,
            mask_miou: metrics.mask_miou,
            azimuth: camera.azimuth_rad,
            elevation: camera.elevation_rad,
            depth_drift: metrics.depth_drift,
            steps_pivot: metrics.steps_pivot,
            steps_tune: metrics.steps_tune,
        })
    }
}

/// Seconds as people say them.
fn duration(seconds: f64) -> String {
    if seconds < 90.0 { format!("{:.0} s", seconds.max(1.0)) } else { format!("{:.0} min", seconds / 60.0) }
}

fn pose(text: &str) -> Result<[f64; 2], String> {
    let values: Vec<f64> = text.split(',').map_while(|part| part.trim().parse().ok()).collect();
    match values.as_slice() {
        [azimuth, elevation] if azimuth.abs() <= 3.2 && elevation.abs() <= 1.6 => Ok([*azimuth, *elevation]),
        _ => Err("must be azimuth,elevation in radians, e.g. 0.2,-0.1".into()),
    }
}
