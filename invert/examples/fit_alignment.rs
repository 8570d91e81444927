//! Fits the alignment cascade to a folder of aligned portraits (`images/`, `dataset.json` with azimuth, elevation and
//! roll) and writes `invert/assets/alignment.safetensors`:
//!
//!     cargo run --release -p cnerf-invert --example fit_alignment -- TRAIN_FOLDER [VALID_FOLDER] [OUT]
//!
//! Every portrait is seen from crops displaced as the detector's boxes displace them (and a little more), mirrored
//! too; each stage is a ridge regression from the crop's features to the move back, fitted to what the stages
//! before it left.

use std::{collections::HashMap, path::Path};

use cnerf_core::rng::Stream;
use cnerf_invert::{
    align::{CropTransform, FEATURES, POSE_OUTPUTS, Regressor, STEP_OUTPUTS, features},
    detect::{self, Face},
    photo,
};
use image::{RgbImage, imageops};
use safetensors::{Dtype, tensor::TensorView};

const STAGES: usize = 4;
const CROPS_PER_PICTURE: usize = 8;
const RIDGE: f64 = 0.02;

struct Sample {
    picture: RgbImage,
    /// Azimuth, elevation, roll, radians.
    pose: [f64; POSE_OUTPUTS],
    face: Option<Face>,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let train = load(Path::new(&arguments.next().ok_or("usage: fit_alignment TRAIN [VALID] [OUT]")?))?;
    let valid = arguments.next().map(|folder| load(Path::new(&folder))).transpose()?.unwrap_or_default();
    let output = arguments
        .next()
        .unwrap_or_else(|| concat!(env!("CARGO_MANIFEST_DIR"), "/assets/alignment.safetensors").to_owned());

    let mut regressor = Regressor { box_to_crop: box_to_crop(&train), ..Regressor::default() };
    println!("{} pictures; box to crop {:?}", train.len(), regressor.box_to_crop);
    let mut crops = displaced(&train, &regressor, CROPS_PER_PICTURE, 1);
    let mut valid_crops = displaced(&valid, &regressor, 4, 2);
    report("start", &train, &crops, &valid, &valid_crops);
    for stage in 0..STAGES {
        let rows: Vec<Vec<f32>> = crops.iter().map(|(index, crop)| features(&train[*index].picture, crop)).collect();
        let targets: Vec<[f64; STEP_OUTPUTS]> =
            crops.iter().map(|(index, crop)| crop.step_to(&CropTransform::whole(&train[*index].picture))).collect();
        regressor.stages.push(ridge(&rows, &targets));
        let last = Regressor { stages: regressor.stages[stage..].to_vec(), ..regressor.clone() };
        for (samples, crops) in [(&train, &mut crops), (&valid, &mut valid_crops)] {
            for (index, crop) in crops.iter_mut() {
                *crop = last.refine(&samples[*index].picture, *crop);
            }
        }
        report(&format!("stage {stage}"), &train, &crops, &valid, &valid_crops);
    }

    // The pose is read where the cascade arrives, not where the truth is.
    let rows: Vec<Vec<f32>> = crops.iter().map(|(index, crop)| features(&train[*index].picture, crop)).collect();
    let targets: Vec<[f64; POSE_OUTPUTS]> = crops.iter().map(|(index, _)| train[*index].pose).collect();
    regressor.pose = ridge(&rows, &targets);
    for (name, samples, crops) in [("train", &train, &crops), ("valid", &valid, &valid_crops)] {
        let mut error = [0.0; POSE_OUTPUTS];
        let mut spread = [0.0; POSE_OUTPUTS];
        for (index, crop) in crops {
            let camera = regressor.pose(&samples[*index].picture, crop);
            let found = [camera.azimuth_rad, camera.elevation_rad, camera.roll_rad];
            for axis in 0..POSE_OUTPUTS {
                error[axis] += (found[axis] - samples[*index].pose[axis]).abs() / crops.len() as f64;
                spread[axis] += samples[*index].pose[axis].abs() / crops.len() as f64;
            }
        }
        println!("{name}: mean absolute error of azimuth, elevation, roll {error:.3?} rad (of zero: {spread:.3?})");
    }
    save(&regressor, &output)?;
    println!("wrote {output}");
    Ok(())
}

fn load(folder: &Path) -> Result<Vec<Sample>, Box<dyn std::error::Error>> {
    let list: serde_json::Value = serde_json::from_slice(&std::fs::read(folder.join("dataset.json"))?)?;
    let mut samples = Vec::new();
    for item in list["items"].as_array().ok_or("dataset.json has no items")? {
        let picture = photo::read(&folder.join(item["image"].as_str().ok_or("an item has no image")?))?;
        let face = detect::faces(&picture)?.into_iter().next();
        let pose = ["azimuth", "elevation", "roll"].map(|key| item[key].as_f64().unwrap_or(0.0));
        let mirrored = imageops::flip_horizontal(&picture);
        let width = f64::from(picture.width());
        let mirrored_face = face.map(|face| Face { centre_x: width - face.centre_x, ..face });
        samples.push(Sample { picture, pose, face });
        samples.push(Sample { picture: mirrored, pose: [-pose[0], pose[1], -pose[2]], face: mirrored_face });
    }
    Ok(samples)
}

/// Mean offset and half side of the crop in the detector's box widths.
fn box_to_crop(samples: &[Sample]) -> [f64; 3] {
    let relations: Vec<[f64; 3]> = samples
        .iter()
        .filter_map(|sample| {
            let (face, crop) = (sample.face?, CropTransform::whole(&sample.picture));
            let values = [crop.centre_x - face.centre_x, crop.centre_y - face.centre_y, crop.half_side];
            Some(values.map(|value| value / face.width))
        })
        .collect();
    println!("the detector finds a face in {} of {}", relations.len(), samples.len());
    std::array::from_fn(|axis| {
        // Medians: a few boxes are false.
        let mut values: Vec<f64> = relations.iter().map(|relation| relation[axis]).collect();
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or([0.0, 0.0, 1.2][axis])
    })
}

/// Crops as the detector would start them, with some more displacement.
fn displaced(samples: &[Sample], regressor: &Regressor, count: usize, seed: u64) -> Vec<(usize, CropTransform)> {
    let mut crops = Vec::new();
    for (index, sample) in samples.iter().enumerate() {
        let mut random = Stream::new(seed, &[index as u64]);
        let whole = CropTransform::whole(&sample.picture);
        // A box far off is a false one: nothing can be learnt from it.
        let start = sample
            .face
            .map(|face| regressor.start(&face))
            .filter(|start| start.step_to(&whole).iter().all(|value| value.abs() < 0.3));
        for _ in 0..count {
            let spread = if start.is_some() { [0.04, 0.04, 0.06, 0.12] } else { [0.08, 0.08, 0.1, 0.12] };
            let step = spread.map(|deviation| deviation * f64::from(random.normal()));
            crops.push((index, start.unwrap_or(whole).moved(step)));
        }
    }
    crops
}

fn report(
    name: &str,
    train: &[Sample],
    crops: &[(usize, CropTransform)],
    valid: &[Sample],
    valid_crops: &[(usize, CropTransform)],
) {
    let error = |samples: &[Sample], crops: &[(usize, CropTransform)]| {
        let mut sum = [0.0; STEP_OUTPUTS];
        for (index, crop) in crops {
            let step = crop.step_to(&CropTransform::whole(&samples[*index].picture));
            (0..STEP_OUTPUTS).for_each(|axis| sum[axis] += step[axis].abs() / crops.len() as f64);
        }
        sum
    };
    println!(
        "{name}: mean absolute error right, down, ln scale, turn: train {:.4?} valid {:.4?}",
        error(train, crops),
        error(valid, valid_crops)
    );
}

/// Ridge regression, `[FEATURES, N]` row-major: solves (XᵀX + λn) W = XᵀY by Cholesky's factors.
fn ridge<const N: usize>(rows: &[Vec<f32>], targets: &[[f64; N]]) -> Vec<f32> {
    let mut normal = vec![0.0f64; FEATURES * FEATURES];
    let mut right = vec![0.0f64; FEATURES * N];
    for (row, target) in rows.iter().zip(targets) {
        for i in 0..FEATURES {
            let value = f64::from(row[i]);
            for j in 0..=i {
                normal[i * FEATURES + j] += value * f64::from(row[j]);
            }
            (0..N).for_each(|output| right[i * N + output] += value * target[output]);
        }
    }
    for i in 0..FEATURES - 1 {
        normal[i * FEATURES + i] += RIDGE * rows.len() as f64;
    }
    for i in 0..FEATURES {
        for j in 0..=i {
            let sum: f64 = (0..j).map(|k| normal[i * FEATURES + k] * normal[j * FEATURES + k]).sum();
            let rest = normal[i * FEATURES + j] - sum;
            normal[i * FEATURES + j] = if i == j { rest.max(1e-12).sqrt() } else { rest / normal[j * FEATURES + j] };
        }
    }
    for output in 0..N {
        for i in 0..FEATURES {
            let sum: f64 = (0..i).map(|k| normal[i * FEATURES + k] * right[k * N + output]).sum();
            right[i * N + output] = (right[i * N + output] - sum) / normal[i * FEATURES + i];
        }
        for i in (0..FEATURES).rev() {
            let sum: f64 = (i + 1..FEATURES).map(|k| normal[k * FEATURES + i] * right[k * N + output]).sum();
            right[i * N + output] = (right[i * N + output] - sum) / normal[i * FEATURES + i];
        }
    }
    right.into_iter().map(|value| value as f32).collect()
}

fn save(regressor: &Regressor, output: &str) -> Result<(), Box<dyn std::error::Error>> {
    let bytes = |values: &[f32]| values.iter().flat_map(|value| value.to_le_bytes()).collect::<Vec<u8>>();
    let mut tensors = vec![
        ("box_to_crop".to_owned(), vec![3], bytes(&regressor.box_to_crop.map(|value| value as f32))),
        ("pose".to_owned(), vec![FEATURES, POSE_OUTPUTS], bytes(&regressor.pose)),
    ];
    for (index, stage) in regressor.stages.iter().enumerate() {
        tensors.push((format!("stage{index}"), vec![FEATURES, STEP_OUTPUTS], bytes(stage)));
    }
    let mut views = Vec::new();
    for (name, shape, data) in &tensors {
        views.push((name.as_str(), TensorView::new(Dtype::F32, shape.clone(), data)?));
    }
    let about = HashMap::from([(
        "about".to_owned(),
        "alignment cascade fitted by cnerf-invert's example fit_alignment; see its source".to_owned(),
    )]);
    std::fs::write(output, safetensors::serialize(views, Some(about))?)?;
    Ok(())
}
