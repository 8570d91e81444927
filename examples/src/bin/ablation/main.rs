//! Ablations: variants of the generator and of its losses, trained with the same data, seed and number of steps, in one
//! table. `docs/ablations.md` has a run and what it says.
//!
//! `ablation OUT [--data PATH | --heads N] [--features LPIPS_WEIGHTS] [--only NAME;NAME…] [--size PIXELS] [--seed S]
//! [--width W] [--style D] [--warmup-steps N] [--field-steps N] [--upsampler-steps N] [--portraits N] [--pictures N]`
//!
//! OUT gets the data (cartoon heads, unless `--data` names a set), every variant's model and sheet of samples, and after
//! each variant `ablation.md` and `ablation.json`. A variant whose model is there is not trained again.

mod measure;
mod variants;

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::Instant,
};

use anyhow::{Context as _, Result, bail};
use candle_core::Device;
use cnerf_core::{
    data::{
        cartoon::{RenderOptions, SynthOptions, synth},
        dataset::{Dataset, DatasetWriter, EncodedItem, PhotoFormat},
        labels::LabelMap,
    },
    eval::features::{PictureFeatures, PooledFeatures},
    train::{
        config::{Stage, TrainConfig},
        field_stage::FieldStage,
        team::Team,
        trainer::{Inputs, StageRun, Start, steps},
        upsampler_stage::UpsamplerStage,
        warmup::Warmup,
    },
};
use serde::Serialize;

use crate::{
    measure::{HairSwap, Measured, measure},
    variants::{VARIANTS, Variant},
};

/// What the command line says.
#[derive(Clone, Debug, Serialize)]
pub struct Options {
    out: PathBuf,
    data: Option<PathBuf>,
    features: Option<PathBuf>,
    /// Names of variants; all if empty.
    only: Vec<String>,
    heads: usize,
    /// Width and height of pictures, pixels.
    size: usize,
    seed: u64,
    /// Width of the networks.
    width: usize,
    /// Length of codes.
    style: usize,
    warmup_steps: usize,
    field_steps: usize,
    upsampler_steps: usize,
    /// Random portraits that are edited and turned.
    portraits: usize,
    /// Pictures for reconstruction and for the distance of distributions.
    pictures: usize,
}

/// A variant's row.
#[derive(Clone, Debug, Serialize)]
struct Row {
    variant: &'static str,
    stage: Stage,
    /// Numbers in the field's networks.
    field_weights: usize,
    /// What went wrong in training, e.g. a loss that is not finite.
    failed: Option<String>,
    /// Of training; none if the model was there.
    seconds: Option<f64>,
    #[serde(flatten)]
    measured: Measured,
}

#[derive(Serialize)]
struct Report<'a> {
    options: &'a Options,
    rows: &'a [Row],
}

fn main() -> Result<()> {
    let options = Options::parse(std::env::args().skip(1))?;
    std::fs::create_dir_all(&options.out).with_context(|| options.out.display().to_string())?;
    let dataset = Arc::new(data(&options)?);
    let device = Device::Cpu;
    let features = options.features.as_ref().map(|path| PooledFeatures::load(path, &device)).transpose()?;
    let features = features.as_ref().map(|features| features as &dyn PictureFeatures);
    // L_STD compares by the discriminator's features: LPIPS's do not take pictures this small.
    let inputs = Inputs { dataset, perceptual: None, start: None, device, team: Team::default() };

    let (mut rows, mut ours) = (Vec::new(), None);
    for variant in VARIANTS {
        let wanted = options.only.is_empty() || options.only.iter().any(|name| name == variant.name);
        let is_ours = ours.is_none();
        if !wanted && !is_ours {
            continue;
        }
        let (trained, seconds) = match train(variant, ours.as_ref(), &inputs, &options) {
            Ok(trained) => trained,
            Err(error) if !is_ours => {
                rows.push(Row { failed: Some(format!("{error:#}")), ..Row::new(variant) });
                report(&options, &rows)?;
                continue;
            }
            Err(error) => return Err(error),
        };
        if wanted {
            let measured = measure(&trained, &inputs.dataset, features, variant.whole_head, &options)?;
            let field_weights = trained.generator.parameters().within("field").count();
            rows.push(Row { field_weights, seconds, measured, ..Row::new(variant) });
            report(&options, &rows)?;
        }
        if is_ours {
            ours = Some(trained);
        }
    }
    print!("{}", table(&rows));
    Ok(())
}

impl Row {
    fn new(variant: &Variant) -> Self {
        Self {
            variant: variant.name,
            stage: variant.stage,
            field_weights: 0,
            failed: None,
            seconds: None,
            measured: Measured::default(),
        }
    }
}

impl Options {
    fn parse(mut arguments: impl Iterator<Item = String>) -> Result<Self> {
        let mut options = Self {
            out: PathBuf::new(),
            data: None,
            features: None,
            only: Vec::new(),
            heads: 200,
            size: 64,
            seed: 0,
            width: 32,
            style: 32,
            warmup_steps: 600,
            field_steps: 48,
            upsampler_steps: 150,
            portraits: 6,
            pictures: 100,
        };
        let mut positional = Vec::new();
        while let Some(argument) = arguments.next() {
            let mut value = || arguments.next().with_context(|| format!("{argument} needs a value"));
            match argument.as_str() {
                "--data" => options.data = Some(value()?.into()),
                "--features" => options.features = Some(value()?.into()),
                "--only" => options.only = value()?.split(';').map(str::to_owned).collect(),
                "--heads" => options.heads = value()?.parse()?,
                "--size" => options.size = value()?.parse()?,
                "--seed" => options.seed = value()?.parse()?,
                "--width" => options.width = value()?.parse()?,
                "--style" => options.style = value()?.parse()?,
                "--warmup-steps" => options.warmup_steps = value()?.parse()?,
                "--field-steps" => options.field_steps = value()?.parse()?,
                "--upsampler-steps" => options.upsampler_steps = value()?.parse()?,
                "--portraits" => options.portraits = value()?.parse()?,
                "--pictures" => options.pictures = value()?.parse()?,
                option if option.starts_with("--") => bail!("unknown option {option}"),
                _ => positional.push(argument),
            }
        }
        options.out = positional.first().context("say where the runs go: ablation OUT")?.into();
        let known = |name: &&String| VARIANTS.iter().any(|variant| variant.name == name.as_str());
        if let Some(unknown) = options.only.iter().find(|name| !known(name)) {
            let names: Vec<&str> = VARIANTS.iter().map(|variant| variant.name).collect();
            bail!("--only {unknown}: no such variant; known: {}", names.join("; "));
        }
        Ok(options)
    }
}

/// The set that `--data` names, or cartoon heads, drawn once.
fn data(options: &Options) -> Result<Dataset> {
    let path = match &options.data {
        Some(path) => path.clone(),
        None => options.out.join("data"),
    };
    if options.data.is_none() && !path.join("dataset.json").exists() {
        let mut writer = DatasetWriter::create(&path, false)?;
        let heads = SynthOptions { count: options.heads, size: options.size, ..SynthOptions::default() };
        for item in synth(options.seed, heads, RenderOptions::default())? {
            let side = item.picture.size as u32;
            let picture = image::RgbImage::from_raw(side, side, item.picture.rgb).context("a picture of its size")?;
            let mask = LabelMap::new(side, side, item.picture.labels)?;
            writer.add(EncodedItem::new(&picture, Some(&mask), Some(item.camera), PhotoFormat::Png)?)?;
        }
        writer.finish()?;
    }
    Ok(Dataset::open(&path)?)
}

/// The variant's trained model, read if it is there; and the seconds that training took.
fn train(variant: &Variant, ours: Option<&Start>, inputs: &Inputs, options: &Options) -> Result<(Start, Option<f64>)> {
    let folder = options.out.join(variant.name.replace([' ', ','], "_"));
    let model = folder.join("model.safetensors");
    if model.exists() {
        return Ok((Start::open(&model, &inputs.device)?, None));
    }
    let config = variant.config(options);
    config.validate()?;
    let began = Instant::now();
    let mut stage = begin(variant.stage, &config, inputs, ours)?;
    for step in 0..steps(&config, variant.stage) {
        let metrics = stage.step(step)?;
        metrics.check_finite()?;
        if step % 50 == 0 {
            let shown: Vec<String> = metrics.0.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
            eprintln!("{} {step}: {}", variant.name, shown.join("  "));
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let trained = stage.finished()?;
    std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())?;
    stage.samples()?.save(folder.join("samples.png"))?;
    if let Some(codes) = &trained.portrait_codes {
        codes.write(&folder.join("codes.safetensors"))?;
    }
    trained.generator.save(&model, "ablation", variant.name)?;
    Ok((trained, Some(seconds)))
}

fn begin(stage: Stage, config: &TrainConfig, inputs: &Inputs, ours: Option<&Start>) -> Result<Box<dyn StageRun>> {
    Ok(match stage {
        Stage::Warmup => Box::new(Warmup::new(config, inputs, None)?),
        Stage::Field => Box::new(FieldStage::new(config, inputs, ours)?),
        Stage::Upsampler => Box::new(UpsamplerStage::new(config, inputs, ours)?),
        Stage::All => bail!("a variant is about one stage"),
    })
}

fn report(options: &Options, rows: &[Row]) -> Result<()> {
    let write = |name: &str, text: String| -> Result<()> {
        let path: &Path = &options.out.join(name);
        std::fs::write(path, text).with_context(|| path.display().to_string())
    };
    write("ablation.md", table(rows))?;
    write("ablation.json", serde_json::to_string_pretty(&Report { options, rows })?)
}

/// Markdown, one row a variant.
fn table(rows: &[Row]) -> String {
    let mut lines = vec![
        "| variant | field weights | training portraits, dB | mask mIoU | ±0.3 rad, dB | hair shape swap: outside share, \
         depth outside | hair texture swap: the same | texture codes carry depth | shape codes carry region colour | FID \
         (blur) |"
            .to_owned(),
        format!("|{}", " --- |".repeat(10)),
    ];
    for row in rows {
        if let Some(reason) = &row.failed {
            lines.push(format!("| {} | {reason} |{}", row.variant, " |".repeat(8)));
            continue;
        }
        let found = &row.measured;
        let swap = |swap: HairSwap| format!("{}, {}", shown(swap.outside_share, 3), tiny(swap.outside_depth));
        lines.push(format!(
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} ({}) |",
            row.variant,
            row.field_weights,
            shown(found.reconstruction_psnr, 2),
            shown(found.mask_miou, 3),
            shown(found.reprojection_psnr, 2),
            swap(found.hair_shape),
            swap(found.hair_texture),
            shown(found.separation.texture.depth, 3),
            shown(found.separation.shape.region_colour, 3),
            shown(found.fid, 1),
            shown(found.blur_fid, 1),
        ));
    }
    lines.join("\n") + "\n"
}

fn shown(value: Option<f64>, digits: usize) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.digits$}"))
}

fn tiny(value: Option<f64>) -> String {
    match value {
        Some(value) if value != 0.0 => format!("{value:.1e}"),
        Some(_) => "0".to_owned(),
        None => "–".to_owned(),
    }
}
