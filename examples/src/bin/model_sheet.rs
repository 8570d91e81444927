//! Sheets to judge a model's edits by, on random portraits:
//!
//! `model_sheet OUT.png --what regions --seeds 4`: a row for each portrait with every region's shape, then its texture,
//! taken from the next one's; `model_sheet OUT.png --what hair --seeds 64`: pairs of portraits, the first with its own
//! hair's shape and with the second's.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use candle_core::{Device, Tensor};
use clap::{Parser, ValueEnum};
use cnerf_core::{
    camera::Camera,
    codes::{Aspect, blend},
    data::picture,
    interop::sheet::Sheet,
    model::generator::Generator,
    region::{Region, RegionSet},
};
use image::RgbImage;

#[derive(Parser, Debug)]
#[command(about = "A sheet of a model's edits on random portraits")]
struct Arguments {
    /// The sheet to write
    #[arg(value_name = "OUT.png")]
    sheet: PathBuf,
    /// What it shows
    #[arg(long, value_enum, default_value = "regions")]
    what: What,
    /// Portraits of seeds 0 to N - 1
    #[arg(long, default_value_t = 4, value_name = "N")]
    seeds: u64,
    /// Truncation
    #[arg(long, default_value_t = 0.7, value_name = "PSI")]
    trunc: f64,
    /// Azimuth of all views, radians
    #[arg(long, default_value_t = 0.0, allow_negative_numbers = true, value_name = "A")]
    azimuth: f64,
    /// The model: `portrait`, `cartoon` or a file
    #[arg(long, default_value = "portrait", value_name = "NAME|PATH")]
    model: String,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum What {
    /// Every region, shape and texture apart
    Regions,
    /// The hair's shape
    Hair,
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let model = match cnerf_models::bytes(&arguments.model) {
        Some(bytes) => Generator::from_bytes(arguments.model.as_ref(), bytes, &Device::Cpu)?,
        None => Generator::open(arguments.model.as_ref(), &Device::Cpu)?,
    };
    let camera = Camera::at(arguments.azimuth, 0.0);
    let codes = |seed: u64| model.codes_from_seed(seed % arguments.seeds.max(1), arguments.trunc);
    let mut sheet = match arguments.what {
        What::Regions => Sheet::new(1 + 2 * Region::ALL.len()),
        What::Hair => Sheet::new(16),
    };
    for seed in 0..arguments.seeds {
        let (own, other) = (codes(seed)?, codes(seed + 1)?);
        sheet = sheet.push(shown(&model, &own, &camera)?, seed.to_string());
        let edits: Vec<(RegionSet, Aspect, String)> = match arguments.what {
            What::Hair => vec![(Region::Hair.into(), Aspect::Shape, format!("< {}", (seed + 1) % arguments.seeds))],
            What::Regions => Region::ALL
                .into_iter()
                .flat_map(|region| [Aspect::Shape, Aspect::Texture].map(|aspect| (region, aspect)))
                .map(|(region, aspect)| (region.into(), aspect, format!("{region} {aspect}")))
                .collect(),
        };
        for (regions, aspect, label) in edits {
            let edited = blend(&own, &other, regions, aspect, 1.0)?;
            sheet = sheet.push(shown(&model, &edited, &camera)?, label);
        }
    }
    sheet.save(&arguments.sheet)?;
    Ok(())
}

fn shown(model: &Generator, codes: &Tensor, camera: &Camera) -> Result<RgbImage> {
    let view = Camera::parameter_tensor(&[*camera], &Device::Cpu)?;
    let picture = model.picture(codes, &view, &model.render_settings())?;
    picture::from_tensor(&picture.rgb.detach())?.into_iter().next().context("nothing was rendered")
}
