//! A near start: what a photo and its regions say about its code, by one linear map.
//!
//! Training portraits have codes of their own, begun as principal components of small pictures and masks (the recipe)
//! and trained since. Ridge regression from the same small pictures finds the noise behind such codes again (their
//! coordinates in the model's population, or the z of a model without), and the model turns it into codes: a portrait
//! with the right hair, skin and background before the first step.
//!
//! Fitted by `cargo run --release -p cnerf-invert --example fit_start` to a model's training portraits; what is embedded
//! is a table of regression weights, no picture.

use std::path::Path;

use candle_core::{DType, Device, Tensor};
use cnerf_core::{
    data::{labels::LabelMap, picture},
    model::file::{self, Tensors},
    region::REGION_COUNT,
};
use image::RgbImage;
use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// Width and height of the small picture, pixels.
const SIDE: u32 = 16;
/// What a region's share counts beside a colour (recipe).
const MASK_SHARE: f32 = 0.7;
/// Length of a feature vector: colours and region shares of the small picture.
pub const FEATURES: usize = (3 + REGION_COUNT) * (SIDE * SIDE) as usize;
const FILE_KEY: &str = "cnerf-start";
const FILE_VERSION: u32 = 1;

#[derive(Serialize, Deserialize)]
struct Header {
    version: u32,
    provenance: String,
}

/// A fitted map from photos to a model's noise.
#[derive(Clone, Debug)]
pub struct NearStart {
    /// `[FEATURES, D]`.
    weight: Tensor,
    /// `[1, D]`.
    bias: Tensor,
}

impl NearStart {
    /// A map from features (see [`features`]) to noise: `weight` `[FEATURES, D]`, `bias` `[1, D]`.
    ///
    /// # Errors
    /// If the shapes are others.
    pub fn new(weight: Tensor, bias: Tensor) -> Result<Self> {
        let &[FEATURES, style_dim] = weight.dims() else {
            return Err(cnerf_core::Error::shape("start.weight", format!("[{FEATURES}, D]"), weight.dims()).into());
        };
        if bias.dims() != [1, style_dim] {
            return Err(cnerf_core::Error::shape("start.bias", [1, style_dim], bias.dims()).into());
        }
        Ok(Self { weight: weight.to_dtype(DType::F32)?, bias: bias.to_dtype(DType::F32)? })
    }

    /// The map in a file's bytes; `name` stands for the file in messages.
    pub fn from_bytes(name: &Path, bytes: &[u8]) -> Result<Self> {
        let (mut tensors, metadata) = file::parse_safetensors(name, bytes)?;
        let header: Header = file::header_of(name, &metadata, FILE_KEY, "a cnerf start")?;
        if header.version != FILE_VERSION {
            return Err(Error::malformed(name, format!("start version {} is not known; update cnerf", header.version)));
        }
        let mut take = |key: &str| tensors.remove(key).ok_or_else(|| Error::malformed(name, format!("has no `{key}`")));
        Self::new(take("weight")?, take("bias")?)
    }

    /// Writes the map as f16. `provenance` says what it was fitted to.
    pub fn save(&self, path: &Path, provenance: &str) -> Result<()> {
        let half = |tensor: &Tensor| tensor.to_dtype(DType::F16);
        let tensors =
            Tensors::from([("weight".to_owned(), half(&self.weight)?), ("bias".to_owned(), half(&self.bias)?)]);
        let header = Header { version: FILE_VERSION, provenance: provenance.to_owned() };
        let header = serde_json::to_string(&header).map_err(|error| Error::malformed(path, error))?;
        Ok(file::write_safetensors(path, &tensors, &[(FILE_KEY, header)])?)
    }

    /// The noise `[1, noise_dim]` of an aligned portrait whose regions are known.
    pub fn noise(&self, portrait: &RgbImage, labels: &LabelMap) -> Result<Tensor> {
        let features = Tensor::from_vec(features(portrait, labels)?, (1, FEATURES), &Device::Cpu)?;
        Ok((features.matmul(&self.weight)? + &self.bias)?)
    }
}

/// What the map reads of an aligned portrait: mean colours, in ±0.5, and region shares of 16×16 squares.
pub fn features(portrait: &RgbImage, labels: &LabelMap) -> Result<Vec<f32>> {
    let small = picture::resize(portrait, SIDE, SIDE)?;
    let colours = small.into_raw().into_iter().map(|value| f32::from(value) / 255.0 - 0.5);
    let shares = labels.one_hot(SIDE, SIDE).into_iter().map(|share| MASK_SHARE * share);
    Ok(colours.chain(shares).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_saved_start_says_the_same_and_damage_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("start.safetensors");
        // The first output is the mean red of the upper left square, the second the background's share there.
        let mut weight = vec![0f32; FEATURES * 2];
        weight[0] = 1.0;
        weight[(3 * SIDE * SIDE) as usize * 2 + 1] = 1.0;
        let weight = Tensor::from_vec(weight, (FEATURES, 2), &Device::Cpu).unwrap();
        let bias = Tensor::new(&[[0f32, 1.0]], &Device::Cpu).unwrap();
        NearStart::new(weight.clone(), bias).unwrap().save(&path, "test").unwrap();
        let bytes = std::fs::read(&path).unwrap();
        let start = NearStart::from_bytes(&path, &bytes).unwrap();
        let portrait = RgbImage::from_pixel(64, 64, image::Rgb([255, 0, 0]));
        let labels = LabelMap::new(32, 32, vec![0; 32 * 32]).unwrap();
        let noise = start.noise(&portrait, &labels).unwrap().to_vec2::<f32>().unwrap();
        // f16 has 11 bits.
        assert!((noise[0][0] - 0.5).abs() < 1e-3 && (noise[0][1] - 1.7).abs() < 1e-3, "{noise:?}");
        assert!(NearStart::new(weight, Tensor::zeros((1, 3), DType::F32, &Device::Cpu).unwrap()).is_err());
        let error = NearStart::from_bytes(Path::new("cut"), &bytes[..50]).unwrap_err().to_string();
        assert!(error.starts_with("cut: "), "{error}");
    }
}
