//! Fits a model's near start to the portraits it was trained on and the codes it gave them:
//!
//!     cargo run --release -p cnerf-invert --example fit_start -- DATA RUN/model.safetensors OUT
//!
//! Ridge regression; the penalty is the best of a few for the last tenth of the portraits, which are then added.

use std::path::Path;

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    data::dataset::Dataset,
    train::{people::People, trainer::Start},
};
use cnerf_invert::start::{FEATURES, NearStart, features};
use image::imageops;
use nalgebra::DMatrix;

const PENALTIES: [f64; 5] = [1.0, 3.0, 10.0, 30.0, 100.0];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [data, model, output] = arguments.as_slice() else { return Err("usage: fit_start DATA MODEL OUT".into()) };
    let dataset = Dataset::open(data)?;
    let Start { generator, portrait_codes } = Start::open(Path::new(model), &Device::Cpu)?;
    let codes = portrait_codes.ok_or("no codes.safetensors beside the model")?;
    let population = generator.population().ok_or("the model has no population")?;
    let noise = population.coordinates(&codes.all(&generator)?)?.detach();
    // Mirror images come after the plain ones, as in training.
    let (mut plain, mut mirrored) = (Vec::new(), Vec::new());
    for index in 0..dataset.len() {
        let item = dataset.item(index)?;
        let mask = item.mask.ok_or("an item has no mask")?;
        plain.push(features(&item.image, &mask)?);
        mirrored.push(features(&imageops::flip_horizontal(&item.image), &mask.mirrored())?);
    }
    let count = plain.len() + mirrored.len();
    let values: Vec<f32> = plain.into_iter().chain(mirrored).flatten().collect();
    let inputs = Tensor::from_vec(values, (count, FEATURES), &Device::Cpu)?;
    let people = People::of(&dataset, true);
    if noise.dim(0)? != people.count() {
        let expected = people.count();
        return Err(format!("{model}: codes of {} portraits, but the data has {expected}", noise.dim(0)?).into());
    }
    // Every view is a way to its person's code.
    let person: Vec<u32> = people.pictures().into_iter().map(|picture| people.row(picture) as u32).collect();
    let noise = noise.index_select(&Tensor::new(person, &Device::Cpu)?, 0)?;
    let half = count / 2;
    let last = half - half / 10;
    let (seen, held): (Vec<u32>, Vec<u32>) = (0..count as u32).partition(|row| (*row as usize % half) < last);
    let rows = |tensor: &Tensor, rows: &[u32]| tensor.index_select(&Tensor::new(rows, &Device::Cpu)?, 0);
    let (inputs_held, noise_held) = (rows(&inputs, &held)?, rows(&noise, &held)?);
    let power = f64::from(noise_held.sqr()?.sum_all()?.to_scalar::<f32>()?);
    let (mut best, mut best_error) = (PENALTIES[0], f64::INFINITY);
    for penalty in PENALTIES {
        let (weight, bias) = ridge(&rows(&inputs, &seen)?, &rows(&noise, &seen)?, penalty)?;
        let error = (inputs_held.matmul(&weight)?.broadcast_add(&bias)? - &noise_held)?.sqr()?.sum_all()?;
        let error = f64::from(error.to_scalar::<f32>()?) / power;
        println!("penalty {penalty}: {:.3} of the held-out portraits' noise explained", 1.0 - error);
        if error < best_error {
            (best, best_error) = (penalty, error);
        }
    }
    let (weight, bias) = ridge(&inputs, &noise, best)?;
    let name = Path::new(data).file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let provenance = format!("ridge regression (penalty {best}) on {count} portraits and mirror images of {name}");
    NearStart::new(weight, bias)?.save(Path::new(output), &provenance)?;
    println!("wrote {output}");
    Ok(())
}

/// Weight `[F, D]` and bias `[1, D]` of the ridge regression from `inputs` `[N, F]` to `outputs` `[N, D]`, solved
/// in the samples' space: they are fewer than features.
fn ridge(inputs: &Tensor, outputs: &Tensor, penalty: f64) -> Result<(Tensor, Tensor), Box<dyn std::error::Error>> {
    let (mean_in, mean_out) = (inputs.mean_keepdim(0)?, outputs.mean_keepdim(0)?);
    let inputs = inputs.broadcast_sub(&mean_in)?;
    let (count, width) = (inputs.dim(0)?, outputs.dim(1)?);
    let matrix = |tensor: &Tensor, columns: usize| -> candle_core::Result<DMatrix<f64>> {
        Ok(DMatrix::from_row_slice(count, columns, &tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()?))
    };
    let mut gram = matrix(&inputs.matmul(&inputs.t()?)?, count)?;
    (0..count).for_each(|index| gram[(index, index)] += penalty);
    let centred = matrix(&outputs.broadcast_sub(&mean_out)?, width)?;
    let shares = gram.cholesky().ok_or("the Gram matrix is not positive")?.solve(&centred);
    let values: Vec<f32> = shares.transpose().iter().map(|value| *value as f32).collect();
    let weight = inputs.t()?.matmul(&Tensor::from_vec(values, (count, width), &Device::Cpu)?)?;
    let bias = (mean_out - mean_in.matmul(&weight)?)?;
    Ok((weight, bias))
}
