//! Gives the portraits a model was trained on codes again where those its training left were lost: the near start's
//! guess of every portrait, written with the model into a folder that a warm-up goes on from.
//!
//!     cargo run --release -p cnerf-invert --example fit_codes -- DATA MODEL START OUT
//!     cnerf train --stage warmup --data DATA --model OUT/model.safetensors --set warmup.learning_rate=0 …
//!
//! START is the model's near start (`models/*_start.safetensors`). Several views of a person give one code, the mean.

use std::{path::Path, sync::Arc};

use candle_core::{Device, Tensor};
use cnerf_core::{
    codes,
    data::dataset::Dataset,
    model::generator::Generator,
    train::{people::People, portrait_codes::PortraitCodes, warmup},
};
use cnerf_invert::start::NearStart;
use image::imageops;

/// Of the presets, so that z is what the first warm-up of these portraits began with.
const SEED: u64 = 0;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [data, model, start, output] = arguments.as_slice() else {
        return Err("usage: fit_codes DATA MODEL START OUT".into());
    };
    let dataset = Arc::new(Dataset::open(data)?);
    let generator = Generator::open(Path::new(model), &Device::Cpu)?;
    let start = NearStart::from_bytes(Path::new(start), &std::fs::read(start)?)?;
    // Mirror images come after the plain ones, as in training.
    let (mut plain, mut mirrored) = (Vec::new(), Vec::new());
    for index in 0..dataset.len() {
        let item = dataset.item(index)?;
        let mask = item.mask.ok_or("an item has no mask")?;
        plain.push(start.noise(&item.image, &mask)?);
        mirrored.push(start.noise(&imageops::flip_horizontal(&item.image), &mask.mirrored())?);
    }
    plain.extend(mirrored);
    let noise = People::of(&dataset, true).mean_of_views(&Tensor::cat(&plain, 0)?)?;
    let wanted = generator.codes_of(&noise)?;
    let noise = warmup::first_noise(&dataset, true, generator.config().field.style_dim, SEED)?;
    let mapped = codes::broadcast(&generator.map(&noise)?)?;
    let offsets = (wanted - &mapped)?.detach();
    let folder = Path::new(output);
    std::fs::create_dir_all(folder)?;
    std::fs::copy(model, folder.join("model.safetensors"))?;
    PortraitCodes { noise: noise.detach(), offsets: Some(offsets) }.write(&folder.join("codes.safetensors"))?;
    println!("wrote {output}");
    Ok(())
}
