//! How well photos are inverted: held-out people, none of whose regions, camera or other views the inverter is told
//! unless asked, measured against what the data set knows of them.

pub mod parsing;
mod people;
mod summary;

use std::{path::Path, time::Instant};

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    eval::{
        consistency::correlation,
        quality::{self, Agreement},
        warp::{Raster, Surface},
    },
    model::generator::Generator,
    region::Region,
};
use image::RgbImage;
use serde::Serialize;

pub use self::{
    people::People,
    summary::{InversionSummary, TurnSummary},
};
use self::{people::Person, summary::mean};
use crate::{
    config::InvertConfig,
    error::Result,
    events::Event,
    inverter::{Inverter, Opened},
    likeness::Likeness,
    parser::RegionParser,
    portrait::Portrait,
    start::NearStart,
};

/// Which inversion is measured: the rows of an ablation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Variant {
    /// Codes and camera alone; the model stays as it is.
    Pivot,
    /// Pivotal tuning as published: every layer at one rate, nothing holds the geometry at other views.
    Plain,
    /// Tuning with slow geometry, depth and masks held at other views.
    #[default]
    Ours,
}

impl Variant {
    /// `config` with the parts of this variant.
    #[must_use]
    pub fn apply(self, mut config: InvertConfig) -> InvertConfig {
        match self {
            Self::Pivot => config.tune_steps = Some(0),
            Self::Plain => {
                (config.tune.depth, config.tune.masks) = (0.0, 0.0);
                config.tune.geometry_rate = config.tune.texture_rate;
            }
            Self::Ours => {}
        }
        config
    }

    /// The name in tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pivot => "pivot",
            Self::Plain => "plain",
            Self::Ours => "ours",
        }
    }
}

/// What an evaluation tells the inverter, and how it inverts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EvaluationOptions {
    /// How to invert, before [`Variant::apply`].
    pub config: InvertConfig,
    /// What to measure.
    pub variant: Variant,
    /// The model's name in the portraits.
    pub model_name: String,
    /// Give the data set's camera and keep it.
    pub known_pose: bool,
    /// Give the data set's region masks.
    pub known_masks: bool,
}

/// What people are inverted with beside the model.
#[derive(Clone, Copy, Default)]
pub struct Helpers<'a> {
    /// Adds a perceptual loss, and the LPIPS metric if it is that.
    pub likeness: Option<&'a Likeness>,
    /// Finds regions and head pose, unless the inverter is told them.
    pub parser: Option<&'a dyn RegionParser>,
    /// Finds first codes.
    pub near: Option<&'a NearStart>,
}

/// What an inversion is measured by; or the means of several, of those that have the number.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Scores {
    /// Wall time, everything included.
    pub seconds: f64,
    /// Of the photo's own view, dB.
    pub psnr: f64,
    /// Of the photo's own view.
    pub ms_ssim: f64,
    /// Perceptual distance, if weights were given.
    pub lpips: Option<f64>,
    /// Mean IoU of the rendered regions, if the data has masks.
    pub mask_miou: Option<f64>,
    /// Mean PSNR at the person's other views, dB, if there are any.
    pub novel_view_psnr: Option<f64>,
    /// The same without the background.
    pub novel_view_foreground_psnr: Option<f64>,
    /// Correlation with the true depth of the head in the photo's view, if the data has it.
    pub depth_correlation: Option<f64>,
    /// Angle between the found and the true direction of view, radians, if the data names it.
    pub pose_error_rad: Option<f64>,
    /// How far tuning moved the depth at other views, world units.
    pub depth_drift: f64,
}

/// What one inversion gave.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct InversionScore {
    /// The photo.
    pub input: String,
    /// How good it is.
    #[serde(flatten)]
    pub scores: Scores,
    /// Each view that the inverter was not shown.
    pub novel_views: Vec<NovelView>,
    /// PSNR over the time spent: (seconds, dB), of what each optimiser step compared.
    #[serde(skip)]
    pub curve: Vec<(f64, f64)>,
}

/// A view that the inverter was not shown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct NovelView {
    /// How far its azimuth is from the photo's, radians.
    pub azimuth_turn_rad: f64,
    /// How far its elevation is from the photo's, radians.
    pub elevation_turn_rad: f64,
    /// dB.
    pub psnr: f64,
    /// Without the background, dB; none without masks.
    pub foreground_psnr: Option<f64>,
}

/// Inverts one of `people` with the help of `helpers` and measures the result; the portrait comes with it. `step` is
/// called after every optimiser step with those done and those there are in all.
///
/// Other views are rendered from the found camera turned by as much as the true cameras are apart: an error of the
/// pose is counted as such and not again at every view.
pub fn invert_one(
    generator: &Generator,
    people: &People,
    index: usize,
    helpers: Helpers<'_>,
    options: &EvaluationOptions,
    step: &mut dyn FnMut(usize, usize),
) -> Result<(InversionScore, Portrait)> {
    let began = Instant::now();
    let side = generator.output_resolution() as u32;
    let person = people.read(index, side, helpers, options)?;
    let read_seconds = began.elapsed().as_secs_f64();
    let photo = person.subject.aligned.picture.clone();
    let mut config = options.variant.apply(options.config.clone());
    config.fixed_camera |= options.known_pose;
    let steps = config.steps();
    // What was read of other views is no part of inverting a photo, but as nothing beside the optimisation.
    let started = Instant::now();
    let mut inverter = Inverter::new(generator, &options.model_name, person.subject.clone(), config, helpers.likeness)?;
    let (mut done, mut curve) = (0, Vec::new());
    while let Some(event) = inverter.step()? {
        if let Event::Pivot(report) | Event::Tune(report) = event {
            done += 1;
            curve.push((read_seconds + started.elapsed().as_secs_f64(), report.psnr));
            step(done, steps.pivot() + steps.tune);
        }
    }
    let portrait = inverter.finish()?.portrait;
    let seconds = read_seconds + started.elapsed().as_secs_f64();
    let opened = Opened::new(&portrait, Path::new(&person.name), generator)?;
    let metrics = &portrait.metrics;
    let mut score = InversionScore {
        input: person.name.clone(),
        scores: Scores {
            seconds,
            psnr: metrics.psnr,
            ms_ssim: metrics.ms_ssim,
            lpips: metrics.lpips,
            depth_drift: metrics.depth_drift,
            ..Scores::default()
        },
        novel_views: Vec::new(),
        curve,
    };
    measure(&person, &photo, &opened, &mut score)?;
    Ok((score, portrait))
}

fn measure(person: &Person, photo: &RgbImage, opened: &Opened, score: &mut InversionScore) -> Result<()> {
    let camera = opened.camera;
    let picture = opened.picture(&camera)?;
    if let Some(labels) = &person.labels {
        let mut agreement = Agreement::default();
        let found = LabelMap::from_masks(&picture.masks.squeeze(0)?)?;
        agreement.add(&labels.resized(found.width(), found.height())?, &found)?;
        score.scores.mask_miou = agreement.mean_iou();
    }
    if let Some(truth) = &person.camera {
        score.scores.pose_error_rad = Some(angle_between(truth, &camera));
    }
    if let Some(depth) = &person.depth {
        let surface = Surface::new(camera, &picture.frame)?;
        score.scores.depth_correlation = depth_correlation(depth, person.labels.as_ref(), &surface, photo.width());
    }
    let Some(truth) = person.camera else { return Ok(()) };
    for other in &person.others {
        let (azimuth_turn_rad, elevation_turn_rad) =
            (other.camera.azimuth_rad - truth.azimuth_rad, other.camera.elevation_rad - truth.elevation_rad);
        let turned = Camera {
            azimuth_rad: camera.azimuth_rad + azimuth_turn_rad,
            elevation_rad: camera.elevation_rad + elevation_turn_rad,
            ..camera
        };
        let found = opened.picture(&turned)?.rgb.clamp(-1.0, 1.0)?;
        let expected = picture::to_tensor(std::slice::from_ref(&other.image), found.device())?;
        let psnr = quality::psnr(&found, &expected)?.first().copied().unwrap_or_default();
        let foreground = other.labels.as_ref().map(|labels| foreground(labels, found.device())).transpose()?;
        let foreground_psnr = match foreground {
            Some(weights) => quality::psnr_within(&found, &expected, &weights)?.first().copied().flatten(),
            None => None,
        };
        score.novel_views.push(NovelView { azimuth_turn_rad, elevation_turn_rad, psnr, foreground_psnr });
    }
    score.scores.novel_view_psnr = mean(score.novel_views.iter().map(|view| view.psnr));
    score.scores.novel_view_foreground_psnr = mean(score.novel_views.iter().filter_map(|view| view.foreground_psnr));
    Ok(())
}

/// 1 where a label map shows the person, `[1, 1, S, S]`.
fn foreground(labels: &LabelMap, device: &Device) -> Result<Tensor> {
    let background = Region::Background.index() as u8;
    let shown = labels.labels().iter().map(|label| f32::from(u8::from(*label != background))).collect::<Vec<_>>();
    let shape = (1, 1, labels.height() as usize, labels.width() as usize);
    Ok(Tensor::from_vec(shown, shape, device)?.to_dtype(DType::F32)?)
}

/// Over the pixels of a picture of `side` x `side` that show the head in both.
fn depth_correlation(truth: &Raster, labels: Option<&LabelMap>, found: &Surface, side: u32) -> Option<f64> {
    let background = Region::Background.index() as u8;
    let pixels = (0..(side * side) as usize).filter_map(|index| {
        let at = |place: usize| (2 * place + 1) as f64 / f64::from(side) - 1.0;
        let point = [at(index % side as usize), -at(index / side as usize)];
        if labels.is_some_and(|labels| labels.labels().get(index).is_none_or(|label| *label == background)) {
            return None;
        }
        let expected = *truth.channels().first()?.get(truth.nearest(point))?;
        (expected < cnerf_core::camera::FAR - 1e-6).then_some(())?;
        Some((expected, found.depth(point)?))
    });
    correlation(pixels)
}

/// The angle between two cameras' directions of view, radians.
fn angle_between(a: &Camera, b: &Camera) -> f64 {
    let direction = |camera: &Camera| camera.world_from_camera().map(|row| row[2]);
    let cosine: f64 = direction(a).iter().zip(direction(b)).map(|(a, b)| a * b).sum();
    cosine.clamp(-1.0, 1.0).acos()
}

#[cfg(test)]
mod tests {
    use cnerf_core::{
        data::{
            cartoon::{RenderOptions, SynthOptions, synth},
            dataset::{DatasetWriter, EncodedItem, PhotoFormat},
        },
        model::file,
    };

    use super::*;
    use crate::inverter::tests::small_generator;

    /// Two cartoon heads of three views each, with depth, in an order that mixes them.
    fn dataset(path: &Path) {
        let options = SynthOptions { count: 2, size: 64, views: 3, ..SynthOptions::default() };
        let mut items: Vec<_> = synth(1, options, RenderOptions::default()).unwrap().collect();
        items.swap(1, 3);
        let mut writer = DatasetWriter::create(path, false).unwrap();
        for item in items {
            let picture = &item.picture;
            let rgb = RgbImage::from_raw(64, 64, picture.rgb.clone()).unwrap();
            let labels = LabelMap::new(64, 64, picture.labels.clone()).unwrap();
            let depth = Tensor::from_slice(&picture.depth, (64, 64), &Device::Cpu).unwrap();
            let bytes =
                file::safetensors_bytes(Path::new("depth"), &file::Tensors::from([("depth".to_owned(), depth)]), &[]);
            let encoded = EncodedItem::new(&rgb, Some(&labels), Some(item.camera), PhotoFormat::Png).unwrap();
            writer.add(encoded.with("head", item.head).attach("depth", "safetensors", bytes.unwrap())).unwrap();
        }
        writer.finish().unwrap();
    }

    #[test]
    fn views_of_one_head_are_one_person_and_the_other_views_are_measured() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("data");
        dataset(&path);
        let people = People::open(&path, 10, 0).unwrap();
        assert_eq!(people.len(), 2);
        let generator = small_generator(3);
        let config = InvertConfig { pivot_steps: Some(3), tune_steps: Some(1), ..InvertConfig::default() };
        let options = EvaluationOptions { config, known_pose: true, known_masks: true, ..EvaluationOptions::default() };
        let mut steps = Vec::new();
        let score =
            invert_one(&generator, &people, 0, Helpers::default(), &options, &mut |done, all| steps.push((done, all)));
        let (score, portrait) = score.unwrap();
        assert_eq!((portrait.source.as_str(), portrait.metrics.psnr), (score.input.as_str(), score.scores.psnr));
        assert_eq!(steps, [(1, 4), (2, 4), (3, 4), (4, 4)]);
        assert_eq!((score.novel_views.len(), score.curve.len()), (2, 4));
        // A known pose is kept, to f32.
        assert!(score.scores.pose_error_rad.unwrap() < 1e-3, "{score:?}");
        assert!(
            score.scores.psnr > 1.0
                && score.scores.novel_view_psnr.unwrap() > 1.0
                && score.scores.mask_miou.unwrap() > 0.0
        );
        assert!(score.scores.depth_correlation.is_some_and(|found| (-1.0..=1.0).contains(&found)), "{score:?}");
        let pivot = EvaluationOptions { variant: Variant::Pivot, ..options };
        let mut count = 0;
        let (again, _) =
            invert_one(&generator, &people, 0, Helpers::default(), &pivot, &mut |_, _| count += 1).unwrap();
        assert_eq!((count, again.scores.depth_drift), (3, 0.0));

        let summary = InversionSummary::of(&[score.clone(), again.clone()], 1);
        assert_eq!((summary.count, summary.failed, summary.mean.lpips), (2, 1, None));
        assert!((summary.mean.psnr - 0.5 * (score.scores.psnr + again.scores.psnr)).abs() < 1e-12);
    }

    #[test]
    fn variants_differ_in_what_holds_geometry() {
        let config = InvertConfig::default();
        assert_eq!(Variant::Ours.apply(config.clone()), config);
        assert_eq!(Variant::Pivot.apply(config.clone()).steps().tune, 0);
        let plain = Variant::Plain.apply(config);
        assert_eq!((plain.tune.depth, plain.tune.masks, plain.tune.geometry_rate), (0.0, 0.0, plain.tune.texture_rate));
    }

    #[test]
    fn pose_errors_are_angles_of_view_whatever_the_roll() {
        let angle = angle_between(&Camera::at(0.1, 0.0), &Camera { roll_rad: 1.0, ..Camera::at(0.4, 0.0) });
        assert!((angle - 0.3).abs() < 1e-9, "{angle}");
    }

    #[test]
    fn folders_without_anybody_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let error = People::open(folder.path(), 1, 0).err().unwrap().to_string();
        assert!(error.contains("dataset.json") && error.contains("photos"), "{error}");
        for name in ["b.PNG", "a.jpg", "notes.txt"] {
            std::fs::write(folder.path().join(name), b"x").unwrap();
        }
        assert_eq!(People::open(folder.path(), 10, 0).unwrap().len(), 2);
    }
}
