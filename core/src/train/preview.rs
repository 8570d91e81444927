//! Grids of pictures that show how far a training run is.

use candle_core::Tensor;
use image::{RgbImage, imageops};

use crate::{
    camera::Camera,
    codes::{self, Aspect},
    data::{labels::LabelMap, loader::Cached, picture},
    error::Result,
    model::generator::{Generator, Picture},
    region::Region,
    train::people::People,
};

/// Side of a cell, pixels.
const CELL: u32 = 96;
/// Side views, radians.
const SIDE_RAD: f64 = 0.4;
/// Training portraits shown.
const COUNT: usize = 6;

/// Training portraits spread over the set: their rows among the codes, and the cameras of their first views.
pub fn spread(people: &People, portraits: &Cached) -> (Vec<u32>, Vec<Camera>) {
    let everyone = people.count();
    let count = everyone.min(COUNT);
    // Not mirrored ones, of which the second half of the rows is made: whoever looks knows the photos.
    let rows = (0..count).map(|place| place * everyone / (2 * count));
    rows.map(|row| (row as u32, portraits.camera(people.first_view(row)).unwrap_or_default())).unzip()
}

/// A row for each of: the training portraits' pictures, region maps and normals, both side views and the normals of
/// one, hair shape and hair texture swapped between neighbours, random portraits, their normals and a side view.
pub fn grid(generator: &Generator, trained: &Tensor, cameras: &[Camera]) -> Result<RgbImage> {
    let device = generator.device();
    let count = cameras.len();
    let own = Camera::parameter_tensor(cameras, &device)?;
    let at = |azimuth_rad: f64| Camera::parameter_tensor(&vec![Camera::at(azimuth_rad, 0.0); count], &device);
    let neighbours = Tensor::cat(&[trained.narrow(0, 1, count - 1)?, trained.narrow(0, 0, 1)?], 0)?;
    let swapped = |aspect| codes::blend(trained, &neighbours, Region::Hair.into(), aspect, 1.0);
    let random = (0..count as u64).map(|seed| generator.codes_from_seed(seed, 0.7)).collect::<Result<Vec<_>>>()?;
    let random = Tensor::cat(&random, 0)?;

    let mut rows: Vec<Vec<RgbImage>> = Vec::new();
    let reconstruction = pictures(generator, trained, &own)?;
    rows.push(picture::from_tensor(&reconstruction.rgb)?);
    rows.push(region_maps(&reconstruction)?);
    rows.extend(normals(&reconstruction)?);
    let left = pictures(generator, trained, &at(-SIDE_RAD)?)?;
    rows.push(picture::from_tensor(&left.rgb)?);
    rows.extend(normals(&left)?);
    rows.push(picture::from_tensor(&pictures(generator, trained, &at(SIDE_RAD)?)?.rgb)?);
    for aspect in [Aspect::Shape, Aspect::Texture] {
        rows.push(picture::from_tensor(&pictures(generator, &swapped(aspect)?, &own)?.rgb)?);
    }
    let front = pictures(generator, &random, &at(0.0)?)?;
    rows.push(picture::from_tensor(&front.rgb)?);
    rows.extend(normals(&front)?);
    rows.push(picture::from_tensor(&pictures(generator, &random, &at(SIDE_RAD)?)?.rgb)?);
    Ok(tile(&rows))
}

/// Random portraits: pictures, region maps, normals, a view from either side.
pub fn random_grid(generator: &Generator) -> Result<RgbImage> {
    const COUNT: u64 = 6;
    let codes = (0..COUNT).map(|seed| generator.codes_from_seed(seed, 0.7)).collect::<Result<Vec<_>>>()?;
    let codes = Tensor::cat(&codes, 0)?;
    let at = |azimuth_rad: f64| {
        Camera::parameter_tensor(&[Camera::at(azimuth_rad, 0.0); COUNT as usize], &generator.device())
    };
    let front = pictures(generator, &codes, &at(0.0)?)?;
    let mut rows = vec![picture::from_tensor(&front.rgb)?, region_maps(&front)?];
    rows.extend(normals(&front)?);
    for side in [-SIDE_RAD, SIDE_RAD] {
        rows.push(picture::from_tensor(&pictures(generator, &codes, &at(side)?)?.rgb)?);
    }
    Ok(tile(&rows))
}

fn pictures(generator: &Generator, codes: &Tensor, cameras: &Tensor) -> Result<Picture> {
    let mut settings = generator.render_settings();
    settings.normals = true;
    generator.picture(codes, cameras, &settings)
}

/// Pictures of the region maps in a batch's masks.
fn region_maps(picture: &Picture) -> Result<Vec<RgbImage>> {
    (0..picture.masks.dim(0)?).map(|index| Ok(LabelMap::from_masks(&picture.masks.get(index)?)?.colours())).collect()
}

/// Pictures of a batch's normals, if they were rendered.
fn normals(picture: &Picture) -> Result<Option<Vec<RgbImage>>> {
    picture.frame.normal.as_ref().map(picture::from_tensor).transpose()
}

/// Rows of pictures, each scaled to a cell.
fn tile(rows: &[Vec<RgbImage>]) -> RgbImage {
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let mut sheet = RgbImage::new(columns * CELL, rows.len() as u32 * CELL);
    for (y, row) in (0..).zip(rows) {
        for (x, cell) in (0..).zip(row) {
            let scaled = imageops::resize(cell, CELL, CELL, imageops::FilterType::Triangle);
            imageops::replace(&mut sheet, &scaled, i64::from(x * CELL), i64::from(y * CELL));
        }
    }
    sheet
}
