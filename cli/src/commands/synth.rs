//! `cnerf synth`: procedural cartoon portraits as a dataset.

use std::path::PathBuf;

use candle_core::{Device, Tensor};
use clap::Args;
use cnerf_core::{
    data::{
        cartoon::{RenderOptions, SynthItem, SynthOptions, synth},
        dataset::{DatasetWriter, EncodedItem, PhotoFormat},
        labels::LabelMap,
    },
    error::Error,
};
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    console::{Console, Outcome},
    options::OverwriteOptions,
};

/// Pictures encoded at once: keeps all threads busy, and memory small.
const CHUNK: usize = 16;

/// Arguments of `cnerf synth`.
#[derive(Args, Debug)]
pub struct SynthArguments {
    #[command(flatten)]
    options: SynthOptions,
    /// Dataset to write: a folder, or a zip by its name
    #[arg(long, value_name = "PATH")]
    out: PathBuf,
    /// What else to write: depth along the view axis, as safetensors [size, size] in world units
    #[arg(long = "with", value_name = "WHAT", value_enum)]
    with: Vec<Extra>,
    #[command(flatten)]
    overwrite: OverwriteOptions,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Extra {
    /// Depth of every pixel
    Depth,
}

#[derive(Serialize)]
struct Report {
    output: PathBuf,
    pictures: usize,
    heads: usize,
    size: usize,
    seconds: f64,
}

impl SynthArguments {
    /// Draws, encodes and writes.
    pub fn run(self, seed: u64, console: &Console) -> anyhow::Result<Outcome> {
        self.options.validate()?;
        self.overwrite.check(&self.out)?;
        let began = std::time::Instant::now();
        let with_depth = self.with.contains(&Extra::Depth);
        let mut writer = DatasetWriter::create(&self.out, self.overwrite.overwrite)?;
        let mut items = synth(seed, self.options.clone(), RenderOptions::default())?;
        let bar = console.bar(self.options.len() as u64, "synth");
        loop {
            let chunk: Vec<SynthItem> = items.by_ref().take(CHUNK).collect();
            if chunk.is_empty() {
                break;
            }
            let encoded: Vec<Result<EncodedItem, Error>> =
                chunk.par_iter().map(|item| encode(item, with_depth)).collect();
            for item in encoded {
                writer.add(item?)?;
                bar.inc(1);
            }
        }
        writer.finish()?;
        bar.finish_and_clear();
        let report = Report {
            output: self.out,
            pictures: self.options.len(),
            heads: self.options.count,
            size: self.options.size,
            seconds: began.elapsed().as_secs_f64(),
        };
        console.result(&report, || {
            format!("{}: {} portraits in {:.1} s", report.output.display(), report.pictures, report.seconds)
        })?;
        Ok(Outcome::Done)
    }
}

fn encode(item: &SynthItem, with_depth: bool) -> Result<EncodedItem, Error> {
    let picture = &item.picture;
    let side = picture.size as u32;
    let rgb = image::RgbImage::from_raw(side, side, picture.rgb.clone());
    let rgb = rgb.ok_or_else(|| Error::shape("picture", [picture.size, picture.size, 3], &[picture.rgb.len()]))?;
    let labels = LabelMap::new(side, side, picture.labels.clone())?;
    let encoded = EncodedItem::new(&rgb, Some(&labels), Some(item.camera), PhotoFormat::Png)?
        .with("head", item.head)
        .with("identity_seed", item.identity_seed);
    if !with_depth {
        return Ok(encoded);
    }
    let depth = Tensor::from_slice(&picture.depth, (picture.size, picture.size), &Device::Cpu)?;
    let bytes = safetensors_bytes(&depth)?;
    Ok(encoded.attach("depth", "safetensors", bytes))
}

fn safetensors_bytes(depth: &Tensor) -> Result<Vec<u8>, Error> {
    let tensors = cnerf_core::model::file::Tensors::from([("depth".to_owned(), depth.clone())]);
    cnerf_core::model::file::safetensors_bytes("depth".as_ref(), &tensors, &[])
}
