//! `cnerf eval quality`: how like photos random portraits are.

use std::path::{Path, PathBuf};

use clap::Args;
use cnerf_core::{
    data::dataset::Dataset,
    eval::{
        features::{PictureFeatures, PooledFeatures},
        realism::{self, Realism, RealismOptions, Reconstruction},
    },
    interop::chart::{Axis, BarChart, histogram},
    model::generator::Generator,
    train::trainer::Start,
};
use cnerf_invert::{
    config::{Effort, InvertConfig},
    evaluation::{EvaluationOptions, Helpers, InversionSummary, People, Variant, invert_one},
    parser::PixelScale,
};
use serde::Serialize;

use super::{PlotOptions, has_codes, model_name, shown, table, truncation};
use crate::{
    console::{Console, Outcome},
    options::ModelOptions,
};

const CHARTS: [&str; 4] = ["distances", "sharpness", "nyquist", "regions"];

/// Arguments of `cnerf eval quality`.
#[derive(Args, Debug)]
pub struct QualityArguments {
    /// Held-out photos: a dataset folder or zip
    #[arg(long, value_name = "PATH")]
    data: PathBuf,
    /// Random portraits to make, and photos to compare them with (or all there are)
    #[arg(long, default_value_t = 256, value_name = "N", value_parser = clap::value_parser!(u32).range(8..=1_000_000))]
    count: u32,
    /// Truncation of the random portraits: 1 draws from all, 0 gives the mean portrait
    #[arg(long, default_value_t = 1.0, value_name = "PSI", value_parser = truncation, allow_negative_numbers = true)]
    trunc: f64,
    /// Network whose features FID and KID are computed in: LPIPS weights (AlexNet or VGG16, safetensors), not comparable
    /// with Inception-FID; or any network in ONNX format that gives one vector a picture, e.g. Inception's. Without it only
    /// sharpness and regions are compared
    #[arg(long, value_name = "FILE")]
    features: Option<PathBuf>,
    /// What an ONNX network wants its colours as [default: symmetric]
    #[arg(long, value_enum, requires = "features")]
    features_input: Option<PixelScale>,
    /// Portraits to reconstruct for `mask_miou`: from the codes beside the model if it was trained on this data, else
    /// by fitting codes to photo and mask at the given camera
    #[arg(long, default_value_t = 4, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=100_000))]
    reconstructions: u32,
    #[command(flatten)]
    model: ModelOptions,
    #[command(flatten)]
    plots: PlotOptions,
}

#[derive(Serialize)]
struct Report {
    model: String,
    data: PathBuf,
    truncation: f64,
    #[serde(flatten)]
    realism: Realism,
    mask_miou: Option<f64>,
    /// Where `mask_miou` is from.
    mask_miou_from: Option<&'static str>,
    /// From training codes only.
    reconstruction: Option<Reconstruction>,
    seconds: f64,
}

impl QualityArguments {
    /// Compares and reports.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        let began = std::time::Instant::now();
        self.plots.check(&CHARTS)?;
        let generator = self.model.load_or("portrait")?;
        let dataset = Dataset::open(&self.data)?;
        let features = self.features.as_ref().map(|path| self.load(path, &generator)).transpose()?;
        let features = features.as_deref();
        let options = RealismOptions { count: self.count as usize, truncation: self.trunc, seed };
        let model = model_name(&self.model).to_owned();
        let (count, side) = (self.count, generator.output_resolution());
        console.note(format_args!(
            "{count} random portraits of `{model}` (truncation {}) against {}, at {side} pixels, {}",
            self.trunc,
            self.data.display(),
            features.map_or("without --features: no FID, no KID", PictureFeatures::name),
        ));
        let bar = console.bar(realism::steps(&dataset, &options) as u64, "quality");
        let realism = realism::realism(&generator, &dataset, features, &options, &mut |done| {
            bar.set_position(done as u64);
        })?;
        bar.finish_and_clear();
        let (reconstruction, mask_miou) = self.reconstruct(&generator, &dataset, features, seed, console)?;
        let mask_miou_from = mask_miou.map(|_| match reconstruction {
            Some(_) => "portraits from their training codes",
            None => "codes fitted to held-out photos and masks",
        });
        self.draw(&realism)?;
        let (data, truncation) = (self.data, self.trunc);
        let seconds = began.elapsed().as_secs_f64();
        let report = Report { model, data, truncation, realism, mask_miou, mask_miou_from, reconstruction, seconds };
        console.result(&report, || summary(&report))?;
        Ok(Outcome::Done)
    }

    /// The network at `path`.
    fn load(&self, path: &Path, generator: &Generator) -> anyhow::Result<Box<dyn PictureFeatures>> {
        if path.extension().is_none_or(|extension| extension != "onnx") {
            let name = path.display();
            anyhow::ensure!(
                self.features_input.is_none(),
                "--features-input is for ONNX networks, and {name} is none; leave it out"
            );
            return Ok(Box::new(PooledFeatures::load(path, &generator.device())?));
        }
        #[cfg(feature = "onnx")]
        return Ok(Box::new(cnerf_invert::features::OnnxFeatures::load(
            path,
            self.features_input.unwrap_or_default(),
        )?));
        #[cfg(not(feature = "onnx"))]
        anyhow::bail!("--features: {}: this build reads no ONNX files; build with `--features onnx`", path.display())
    }

    /// Regions of portraits whose photos are known, and how well they show those if the model was trained on them.
    fn reconstruct(
        &self,
        generator: &Generator,
        dataset: &Dataset,
        features: Option<&dyn PictureFeatures>,
        seed: u64,
        console: &Console,
    ) -> anyhow::Result<(Option<Reconstruction>, Option<f64>)> {
        let count = self.reconstructions as usize;
        if count == 0 {
            return Ok((None, None));
        }
        let path = Path::new(model_name(&self.model));
        if has_codes(path)
            && let Some(codes) = Start::open(path, &generator.device())?.portrait_codes
            && realism::are_codes_of(&codes, dataset)
        {
            let options = RealismOptions { count, truncation: self.trunc, seed };
            let found = realism::reconstruction(generator, &codes, dataset, features, &options)?;
            return Ok((Some(found), found.mask_miou));
        }
        if !dataset.entries().iter().all(|entry| entry.mask.is_some() && entry.camera.is_some()) {
            return Ok((None, None));
        }
        let people = People::open(&self.data, count, seed)?;
        let options = EvaluationOptions {
            config: InvertConfig { effort: Effort::Fast, seed, ..InvertConfig::default() },
            variant: Variant::Pivot,
            model_name: model_name(&self.model).to_owned(),
            known_pose: true,
            known_masks: true,
        };
        let bar = console.bar(people.len() as u64, "masks");
        let mut scores = Vec::new();
        for index in 0..people.len() {
            let (score, _) = invert_one(generator, &people, index, Helpers::default(), &options, &mut |_, _| {})?;
            scores.push(score);
            bar.inc(1);
        }
        bar.finish_and_clear();
        Ok((None, InversionSummary::of(&scores, 0).mean.mask_miou))
    }

    fn draw(&self, found: &Realism) -> anyhow::Result<()> {
        let names = ["random portraits".to_owned(), "photos".to_owned()];
        let pairs = |values: &[Vec<f64>; 2]| names.iter().cloned().zip(values.iter().cloned()).collect::<Vec<_>>();
        if let (Some(path), Some(features)) = (self.plots.path("distances"), &found.features) {
            let bars = [
                ("random portraits", found.fid),
                ("one half of the photos", found.floor_fid),
                ("blurred photos", found.blur_fid),
            ];
            let bars: Vec<_> = bars.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))).collect();
            let title = format!("Fréchet distance to {} photos", found.real_count);
            let axis = Axis::linear(format!("squared distance in {features}"));
            BarChart::single(title, "", axis, &bars).save(path)?;
        }
        if let Some(path) = self.plots.path("sharpness") {
            let axis = Axis::linear("standard deviation of the Laplacian, colours in [0, 1]");
            histogram("Sharpness", axis, &pairs(&found.values.sharpness)).save(path)?;
        }
        if let Some(path) = self.plots.path("nyquist") {
            let axis = Axis::logarithmic("share of the luma's variance near the Nyquist frequency");
            histogram("Energy near the Nyquist frequency", axis, &pairs(&found.values.nyquist)).save(path)?;
        }
        if let Some(path) = self.plots.path("regions") {
            let column =
                |value: &dyn Fn(&realism::RegionShare) -> Option<f64>| found.regions.iter().map(value).collect();
            let chart = BarChart {
                title: "What regions cover".into(),
                x_title: "region".into(),
                y: Axis::linear("share of all pixels"),
                names: found.regions.iter().map(|share| share.region.name().to_owned()).collect(),
                series: vec![
                    (names[0].clone(), column(&|share| Some(share.generated))),
                    (names[1].clone(), column(&|share| share.real)),
                ],
            };
            chart.save(path)?;
        }
        Ok(())
    }
}

fn summary(report: &Report) -> String {
    let found = &report.realism;
    let of_real = |compared: realism::Compared| format!("{:.2} of the photos'", compared.share);
    let mut rows =
        vec![("pictures", format!("{} random, {} photos, {} pixels", found.count, found.real_count, found.resolution))];
    if let Some(features) = &found.features {
        rows.extend([
            ("features", format!("{features} (not comparable with Inception-FID)")),
            (
                "FID",
                format!(
                    "{}  floor {}  blur {}",
                    shown(found.fid, 3),
                    shown(found.floor_fid, 3),
                    shown(found.blur_fid, 3)
                ),
            ),
            ("FID, unbiased", shown(found.fid_infinity, 3)),
            (
                "KID",
                format!(
                    "{}  floor {}  blur {}",
                    shown(found.kid, 4),
                    shown(found.floor_kid, 4),
                    shown(found.blur_kid, 4)
                ),
            ),
            ("of the blur", format!("FID {}  KID {}", shown(found.fid_of_blur, 2), shown(found.kid_of_blur, 2))),
            ("precision", shown(found.precision, 2)),
            ("recall", shown(found.recall, 2)),
        ]);
    }
    rows.extend([
        ("sharpness", of_real(found.sharpness)),
        ("near Nyquist", of_real(found.nyquist)),
        ("region overlap", shown(found.region_map_overlap, 2)),
        ("mask mIoU", format!("{} {}", shown(report.mask_miou, 2), report.mask_miou_from.unwrap_or_default())),
    ]);
    if let Some(found) = &report.reconstruction {
        let lpips = shown(found.lpips, 3);
        rows.push((
            "from codes",
            format!(
                "render {:.2} dB, picture {:.2} dB, LPIPS {lpips}, sharpness {}",
                found.render_psnr,
                found.psnr,
                of_real(found.sharpness)
            ),
        ));
    }
    table(&rows)
}
