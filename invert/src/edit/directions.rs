//! Directions of change found without labels: the principal components of what a region's layers receive.
//!
//! The generator's codes vary, and each region's layers see that variation through their own linear maps (FiLM). In
//! coordinates in which the codes have unit variance, the components of what arrives, strongest first, are the
//! directions in which that region of portraits differs most. (GANSpace, Härkönen et al. 2020, takes the components of
//! the codes; those would be the same for every region. SeFa, Shen and Zhou 2021, takes those of the first layer's
//! weights; those would forget how codes are spread.)

use std::path::Path;

use candle_core::{DType, Tensor};
use cnerf_core::{
    codes::{self, Aspect},
    config::SHAPE_LAYERS,
    model::generator::Generator,
    region::{REGION_COUNT, RegionSet},
};
use image::RgbImage;
use nalgebra::{DMatrix, SymmetricEigen};

use crate::{
    error::{Error, Result},
    inverter::{Opened, one_picture},
    portrait::Portrait,
    space::CodeSpace,
};

/// The first `count` directions of `regions` and `aspect`, strongest first: `[count, 9, 2, D]`, each one standard deviation
/// of the model's portraits long. Signs are fixed, so that the same model gives the same directions.
///
/// # Errors
/// [`Error::Core`] if there are fewer directions.
pub fn directions(model: &Generator, regions: RegionSet, aspect: Aspect, count: usize) -> Result<Tensor> {
    let space = CodeSpace::measure(model)?;
    let length = space.coordinate_count();
    if count == 0 || count > length {
        return Err(Error::config("--direction", format!("this model has directions 1 to {length}")));
    }
    // What a unit step along each coordinate changes in each region's layers. The maps are affine: a unit step will do.
    let device = model.device();
    let steps = space.components()?;
    let mean = model.mean_codes()?;
    let moved = steps.broadcast_add(&mean)?;
    let change = model.field().film(&moved)?.broadcast_sub(&model.field().film(&mean)?)?.detach();
    let layers = change.dim(2)?;
    let mut gram = Tensor::zeros((length, length), DType::F64, &device)?;
    for region in regions.iter() {
        for row in (0..2).filter(|row| aspect.covers(*row)) {
            let (first, last) = if row == 0 { (0, SHAPE_LAYERS) } else { (SHAPE_LAYERS, layers) };
            let received = change.narrow(1, region.index(), 1)?.narrow(2, first, last - first)?;
            let received = received.flatten_from(1)?.to_dtype(DType::F64)?;
            gram = (gram + received.matmul(&received.t()?)?)?;
        }
    }
    let values: Vec<f64> = gram.flatten_all()?.to_vec1()?;
    let eigen = SymmetricEigen::new(DMatrix::from_row_slice(length, length, &values));
    let mut order: Vec<usize> = (0..length).collect();
    let strength = |index: usize| eigen.eigenvalues.get(index).copied().unwrap_or(0.0);
    order.sort_by(|a, b| strength(*b).total_cmp(&strength(*a)));
    let mut whitened = Vec::with_capacity(count * length);
    for index in order.into_iter().take(count) {
        let vector: Vec<f64> = eigen.eigenvectors.column(index).iter().copied().collect();
        let largest = vector.iter().copied().max_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(1.0);
        whitened.extend(vector.iter().map(|value| (value * largest.signum()) as f32));
    }
    let directions = Tensor::from_vec(whitened, (count, length), &device)?.matmul(&steps.flatten_from(1)?)?;
    Ok(directions.reshape((count, REGION_COUNT, 2, model.config().field.style_dim))?)
}

/// The portrait, read from `path`, moved along each of the first `count` directions by each of `amounts`: one row of
/// pictures a direction, in the portrait's own view.
pub fn preview(
    portrait: &Portrait,
    path: &Path,
    model: &Generator,
    (regions, aspect): (RegionSet, Aspect),
    count: usize,
    amounts: &[f64],
) -> Result<Vec<Vec<RgbImage>>> {
    let opened = Opened::new(portrait, path, model)?;
    let rows = directions(model, regions, aspect, count)?;
    let picture = |direction: usize, amount: f64| -> Result<RgbImage> {
        let step = rows.narrow(0, direction, 1)?;
        let goal = opened.codes.broadcast_add(&step)?;
        let codes = codes::blend(&opened.codes, &goal, regions, aspect, amount)?.detach();
        one_picture(&Opened { codes, ..opened.clone() }.picture(&portrait.camera)?.rgb)
    };
    (0..count).map(|direction| amounts.iter().map(|amount| picture(direction, *amount)).collect()).collect()
}
