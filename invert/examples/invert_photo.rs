//! A photo to a portrait file and a picture of its panels:
//! `cargo run --release -p cnerf-invert --example invert_photo -- MODEL PHOTO OUT.cnerf [fast|balanced|best] [LPIPS]`

use std::path::Path;

use candle_core::Device;
use cnerf_core::{eval::perceptual::Perceptual, model::generator::Generator};
use cnerf_invert::{
    config::{Effort, InvertConfig},
    events::Event,
    inverter::Inverter,
    likeness::Likeness,
    photo::{PhotoOptions, Subject},
};
use image::{RgbImage, imageops};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [model, photo, output, rest @ ..] = arguments.as_slice() else {
        return Err("usage: invert_photo MODEL PHOTO OUT.cnerf [fast|balanced|best] [LPIPS]".into());
    };
    let effort = match rest.first().map(String::as_str) {
        Some("fast") => Effort::Fast,
        Some("best") => Effort::Best,
        _ => Effort::Balanced,
    };
    let generator = Generator::open(model.as_ref(), &Device::Cpu)?;
    let likeness = rest.get(1).map(|file| Perceptual::load(file, &Device::Cpu)).transpose()?.map(Likeness::Lpips);
    let size = generator.output_resolution() as u32;
    let subject = Subject::read(Path::new(photo), &PhotoOptions::default(), None, size)?;
    let config = InvertConfig { effort, ..InvertConfig::default() };

    let mut inverter = Inverter::new(&generator, model, subject, config, likeness.as_ref())?;
    while let Some(event) = inverter.step()? {
        match event {
            Event::Pivot(report) | Event::Tune(report) if report.step % 20 == 0 || report.step == report.total => {
                eprintln!("{}/{}: loss {:.4}, {:.2} dB", report.step, report.total, report.loss, report.psnr);
            }
            Event::Settled { step } => eprintln!("settled after {step} steps"),
            Event::Warning(text) => eprintln!("{text}"),
            _ => {}
        }
    }
    let inversion = inverter.finish()?;
    inversion.portrait.save(Path::new(output))?;
    println!("{}", serde_json::to_string_pretty(&inversion.portrait.metrics)?);
    println!("{:?}", inversion.portrait.camera);

    let panels = &inversion.panels;
    let [left, right] = &panels.novel;
    let row = [&panels.photo, &panels.pivot, &panels.tuned, &panels.regions, &panels.depth, left, right];
    let mut sheet = RgbImage::new(size * row.len() as u32, size);
    for (index, picture) in row.into_iter().enumerate() {
        imageops::replace(&mut sheet, picture, i64::from(size) * index as i64, 0);
    }
    sheet.save(Path::new(output).with_extension("png"))?;
    Ok(())
}
