//! Sheets of cartoon portraits to look at: many heads at a dataset's cameras, their label maps and normals, or a few
//! heads all around.
//!
//! `cartoon_sheet OUT.png [rgb|labels|normals|views|styles] [--seed S] [--size PIXELS] [--heads N] [--edge-samples N]`

use std::{path::PathBuf, time::Instant};

use anyhow::{Context as _, Result, bail};
use cnerf_core::{
    camera::Camera,
    data::cartoon::{CartoonPicture, HairStyle, Identity, Portrait, RenderOptions, SynthOptions, synth},
    region::Region,
};
use image::{Rgb, RgbImage};

fn main() -> Result<()> {
    let mut positional = Vec::new();
    let (mut seed, mut size, mut heads) = (0u64, 128usize, 64usize);
    let mut render = RenderOptions::default();
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        let mut value = || arguments.next().with_context(|| format!("{argument} needs a value"));
        match argument.as_str() {
            "--seed" => seed = value()?.parse()?,
            "--size" => size = value()?.parse()?,
            "--heads" => heads = value()?.parse()?,
            "--edge-samples" => render.edge_samples = value()?.parse()?,
            option if option.starts_with("--") => bail!("unknown option {option}"),
            _ => positional.push(argument),
        }
    }
    let path = PathBuf::from(positional.first().context("say where to write the sheet")?);
    let kind = positional.get(1).map_or("rgb", String::as_str);

    let started = Instant::now();
    let (columns, tiles): (usize, Vec<RgbImage>) = match kind {
        "rgb" | "labels" | "normals" => {
            let options = SynthOptions { count: heads, size, ..SynthOptions::default() };
            let tiles = synth(seed, options, render)?.map(|item| tile(&item.picture, kind)).collect();
            (heads.isqrt().max(1), tiles)
        }
        "views" => {
            let azimuths = [-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.57, std::f64::consts::PI];
            let tiles = (0..heads).flat_map(|head| {
                let portrait = Portrait::new(&Identity::sample(SynthOptions::identity_seed(seed, head)));
                azimuths.map(|azimuth| {
                    let elevation = if azimuth == 0.4 {
                        0.5
                    } else if azimuth == -0.4 {
                        -0.4
                    } else {
                        0.0
                    };
                    tile(&portrait.render(&Camera::at(azimuth, elevation), size, &render), "rgb")
                })
            });
            (azimuths.len(), tiles.collect())
        }
        "styles" => {
            let azimuths = [0.0, 0.6, 1.57, std::f64::consts::PI];
            let tiles = HairStyle::ALL.into_iter().enumerate().flat_map(|(head, style)| {
                let mut identity = Identity::sample(SynthOptions::identity_seed(seed, head));
                identity.hair.style = style;
                let portrait = Portrait::new(&identity);
                azimuths.map(|azimuth| tile(&portrait.render(&Camera::at(azimuth, 0.0), size, &render), "rgb"))
            });
            (2 * azimuths.len(), tiles.collect())
        }
        other => bail!("unknown sheet `{other}`: rgb, labels, normals, views or styles"),
    };
    let seconds = started.elapsed().as_secs_f64();
    println!("{} pictures in {seconds:.2} s: {:.2} a second", tiles.len(), tiles.len() as f64 / seconds);

    let rows = tiles.len().div_ceil(columns);
    let mut sheet = RgbImage::new((columns * size) as u32, (rows * size) as u32);
    for (index, tile) in tiles.iter().enumerate() {
        image::imageops::replace(&mut sheet, tile, (index % columns * size) as i64, (index / columns * size) as i64);
    }
    sheet.save(&path).with_context(|| format!("cannot write {}", path.display()))
}

fn tile(picture: &CartoonPicture, kind: &str) -> RgbImage {
    let size = picture.size as u32;
    RgbImage::from_fn(size, size, |x, y| {
        let index = (y * size + x) as usize;
        let triple = |values: &[u8]| Rgb([values[3 * index], values[3 * index + 1], values[3 * index + 2]]);
        match kind {
            "labels" => Rgb(Region::from_label(picture.labels[index]).unwrap_or(Region::Background).colour()),
            "normals" => Rgb(std::array::from_fn(|axis| (127.5 * (picture.normal[3 * index + axis] + 1.0)) as u8)),
            _ => triple(&picture.rgb),
        }
    })
}
