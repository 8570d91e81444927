//! `cnerf invert`: photos to portrait files. Listens to the inverter and draws its progress.

use std::{
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use anyhow::{Context as _, bail};
use clap::Args;
use cnerf_core::{data::picture, model::generator::Generator};
use cnerf_invert::{
    checkpoint,
    config::InvertConfig,
    events::Event,
    inverter::{Inversion, Inverter, estimate_seconds},
    likeness::Likeness,
    parser::{ParserConfig, RegionParser},
    photo::{PhotoOptions, Subject},
    portrait::Portrait,
    start::NearStart,
};
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    interrupt::{Interrupt, command_to_resume},
    options::{ModelOptions, OverwriteOptions, stem},
    views::side_by_side,
};

/// What has been done is written this often at least.
const CHECKPOINT_EVERY: Duration = Duration::from_secs(10);

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
    /// The photos show one person: share codes and tuned weights, with a camera for each
    #[arg(long)]
    same_person: bool,
    /// LPIPS weights (AlexNet or VGG16, safetensors) for the perceptual loss, in place of the built-in parser's features
    #[arg(long, value_name = "FILE")]
    lpips: Option<PathBuf>,
    #[command(flatten)]
    model: ModelOptions,
    /// Go on with what was stopped: finished portraits stay, the one under way continues from its last checkpoint
    #[arg(long, conflicts_with = "overwrite")]
    resume: bool,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

/// What all photos are inverted with.
#[derive(Clone, Copy)]
struct Tools<'a> {
    generator: &'a Generator,
    likeness: &'a Likeness,
    parser: Option<&'a dyn RegionParser>,
    near: Option<&'a NearStart>,
    interrupt: &'a Interrupt,
}

#[derive(Default, Serialize)]
struct Report {
    portraits: Vec<Inverted>,
    failed: Vec<Failed>,
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    interrupted: bool,
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

impl Inverted {
    fn of(input: &Path, output: PathBuf, portrait: &Portrait, seconds: f64) -> Self {
        let (metrics, camera) = (&portrait.metrics, portrait.camera);
        Self {
            input: input.to_owned(),
            output,
            seconds,
            psnr: metrics.psnr,
            ms_ssim: metrics.ms_ssim,
            lpips: metrics.lpips,
            mask_miou: metrics.mask_miou,
            azimuth: camera.azimuth_rad,
            elevation: camera.elevation_rad,
            depth_drift: metrics.depth_drift,
            steps_pivot: metrics.steps_pivot,
            steps_tune: metrics.steps_tune,
        }
    }
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
            if !self.resume {
                self.overwrite.check(&output)?;
            }
            if let Some(other) = self.photos.iter().take(index).find(|other| self.output(other) == output) {
                let (photo, other, output) = (photo.display(), other.display(), output.display());
                bail!("{photo} and {other} would both become {output}: rename one, or invert them apart");
            }
        }
        let generator = self.model.load_or("portrait")?;
        let likeness = Likeness::load(self.lpips.as_deref(), cnerf_models::parser(), &generator.device())?;
        let parser = self.parser.load(cnerf_models::parser())?;
        let interrupt = Interrupt::listen()?;
        let near = self.model.near_start("portrait")?;
        let (parser, near) = (parser.as_deref(), near.as_ref());
        let tools = Tools { generator: &generator, likeness: &likeness, parser, near, interrupt: &interrupt };
        let mut report = Report::default();
        let groups: Vec<&[PathBuf]> =
            if self.same_person { vec![self.photos.as_slice()] } else { self.photos.chunks(1).collect() };
        let mut told = console.is_quiet();
        for photos in groups {
            if self.resume && self.keep_finished(photos, &mut report, console)? {
                continue;
            }
            let failed = report.failed.len();
            let subjects = self.read(photos, &tools, &mut report, console);
            if !told && !subjects.is_empty() {
                told = true;
                self.tell_time(&tools, console)?;
            }
            if let Err(error) = self.invert(subjects, &tools, &mut report, console) {
                let unread = report.failed.iter().skip(failed).map(|one| one.input.clone()).collect::<Vec<_>>();
                for photo in photos.iter().filter(|photo| !unread.contains(photo)) {
                    self.fail(photo, &error, &mut report, console);
                }
            }
            if report.interrupted {
                break;
            }
        }
        if report.interrupted {
            console.warn(format_args!("stopped; go on with: {}", command_to_resume()));
        } else if report.portraits.is_empty() {
            if let [only] = report.failed.as_slice() {
                bail!("{}", only.error);
            }
            bail!("none of {} photos could be inverted", self.photos.len());
        }
        let partial = report.interrupted || !report.failed.is_empty();
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

    /// Whether all these photos have their portraits already, which are then reported.
    fn keep_finished(&self, photos: &[PathBuf], report: &mut Report, console: &Console) -> anyhow::Result<bool> {
        if !photos.iter().all(|photo| self.output(photo).exists()) {
            return Ok(false);
        }
        for photo in photos {
            let portrait = Portrait::load(&self.output(photo))?;
            console.note(format_args!("{}: finished before", self.output(photo).display()));
            report.portraits.push(Inverted::of(photo, self.output(photo), &portrait, 0.0));
        }
        Ok(true)
    }

    /// Says how long it will take, before it does.
    fn tell_time(&self, tools: &Tools<'_>, console: &Console) -> anyhow::Result<()> {
        let seconds = estimate_seconds(tools.generator, &self.config, Some(tools.likeness))?;
        let (effort, count) = (self.config.effort.name(), self.photos.len());
        let photos = match (count, self.same_person) {
            (1, _) => "the photo".to_owned(),
            (_, true) => "all photos together".to_owned(),
            (_, false) => format!("each of {count} photos"),
        };
        console.note(format_args!("{effort} effort: about {} for {photos}", duration(seconds)));
        Ok(())
    }

    fn output(&self, photo: &Path) -> PathBuf {
        self.out.join(stem(photo)).with_extension("cnerf")
    }

    /// Reads photos; those that cannot be used are reported and left out.
    fn read<'p>(
        &self,
        photos: &'p [PathBuf],
        tools: &Tools<'_>,
        report: &mut Report,
        console: &Console,
    ) -> Vec<(&'p Path, Subject)> {
        let options = PhotoOptions { face: self.face, aligned: self.aligned, pose: self.pose, mask: self.mask.clone() };
        let side = tools.generator.output_resolution() as u32;
        let mut subjects = Vec::with_capacity(photos.len());
        for photo in photos {
            let read = Subject::read(photo, &options, tools.parser, side).and_then(|mut subject| {
                tools.near.map_or(Ok(()), |near| subject.start_near(near))?;
                Ok(subject)
            });
            match read {
                Ok(subject) => {
                    if let Some(seconds) = subject.parser_seconds {
                        console.note(format_args!("{}: regions parsed in {seconds:.1} s", photo.display()));
                    }
                    subjects.push((photo.as_path(), subject));
                }
                Err(error) => self.fail(photo, &error.into(), report, console),
            }
        }
        subjects
    }

    fn fail(&self, photo: &Path, error: &anyhow::Error, report: &mut Report, console: &Console) {
        if self.photos.len() > 1 {
            console.error(error);
        }
        report.failed.push(Failed { input: photo.to_owned(), error: format!("{error:#}") });
    }

    /// Inverts photos of one person and writes their portraits.
    fn invert(
        &self,
        photos: Vec<(&Path, Subject)>,
        tools: &Tools<'_>,
        report: &mut Report,
        console: &Console,
    ) -> anyhow::Result<()> {
        let Tools { generator, likeness, .. } = *tools;
        let (paths, subjects): (Vec<&Path>, Vec<Subject>) = photos.into_iter().unzip();
        let Some(first) = paths.first() else { return Ok(()) };
        let began = Instant::now();
        let model_name = self.model.model.as_deref().unwrap_or("portrait");
        let mut inverter = Inverter::of_person(generator, model_name, subjects, self.config.clone(), Some(likeness))?;
        let part = checkpoint::path_of(&self.output(first));
        if self.resume && part.exists() {
            inverter.resume(&part)?;
            let (done, all) = inverter.progress();
            console.note(format_args!("{}: goes on after step {done} of {all}", first.display()));
        }
        let mut bar = console.bar(0, "pivot");
        let mut tuning = false;
        let mut saved = Instant::now();
        while let Some(event) = inverter.step().with_context(|| first.display().to_string())? {
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
            let stop = tools.interrupt.asked();
            if stop || inverter.ended_phase() || saved.elapsed() > CHECKPOINT_EVERY {
                inverter.save(&part)?;
                saved = Instant::now();
            }
            if stop {
                bar.finish_and_clear();
                report.interrupted = true;
                return Ok(());
            }
        }
        let inversions = inverter.finish_all()?;
        bar.finish_and_clear();
        for (photo, Inversion { portrait, panels }) in paths.into_iter().zip(inversions) {
            let output = self.output(photo);
            let [left, right] = panels.novel;
            let strip = [panels.photo, panels.pivot, panels.tuned, panels.regions, panels.depth, left, right];
            portrait.save(&output)?;
            picture::write(&output.with_extension("png"), &side_by_side(&strip))?;
            let seconds = began.elapsed().as_secs_f64();
            console.note(format_args!("{}: {:.1} dB in {seconds:.0} s", output.display(), portrait.metrics.psnr));
            report.portraits.push(Inverted::of(photo, output, &portrait, seconds));
        }
        match std::fs::remove_file(&part) {
            Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
                Err(error).with_context(|| part.display().to_string())
            }
            _ => Ok(()),
        }
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
