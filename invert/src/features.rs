//! Feature vectors of pictures by a network in ONNX format, for `eval quality --features FILE.onnx`: Inception for a FID in
//! the features of published tables, by who has its weights.

use std::path::{Path, PathBuf};

use candle_core::Tensor;
use cnerf_core::{data::picture, eval::features::PictureFeatures};
use tract_onnx::prelude::*;

use crate::{
    error::{Error, Result},
    parser::{
        PixelScale,
        onnx::{Input, LARGEST_FILE, Network, contained, network, one_line},
    },
};

/// What the network is, for messages.
const PURPOSE: &str = "feature network";
/// How many numbers a vector may have.
const LENGTHS: std::ops::RangeInclusive<usize> = 2..=1 << 16;

/// A network that gives one vector a picture.
pub struct OnnxFeatures {
    path: PathBuf,
    name: String,
    network: Network,
    input: Input,
    scale: PixelScale,
    length: usize,
}

impl OnnxFeatures {
    /// Loads a network of one picture in and one vector `[1, L]`, or `[1, L, 1, 1]`, out. Pictures are brought to its size,
    /// enlarged by Lanczos' filter or reduced by area averages, and their colours to `scale`.
    ///
    /// # Errors
    /// Names the file: it cannot be read, is no ONNX file, or gives something else.
    pub fn load(path: &Path, scale: PixelScale) -> Result<Self> {
        let bytes = picture::read_file(path, LARGEST_FILE)?;
        let refuse = |reason: String| Error::malformed(path, reason);
        let (network, input) = contained(PURPOSE, || network(&bytes, PURPOSE)).map_err(refuse)?;
        let fact = contained(PURPOSE, || network.model().output_fact(0).cloned().map_err(one_line)).map_err(refuse)?;
        let shape = fact.shape.as_concrete().unwrap_or_default();
        let length = shape.iter().product();
        let is_vector = shape.first() == Some(&1) && shape.iter().filter(|size| **size != 1).count() == 1;
        if !fact.datum_type.is_float() || !is_vector || !LENGTHS.contains(&length) {
            let found = format!("gives {:?} {shape:?}", fact.datum_type);
            return Err(refuse(format!("{found}; a {PURPOSE} gives one vector [1, L]: cut it off after its pooling")));
        }
        let stem = path.file_stem().unwrap_or_default().to_string_lossy();
        Ok(Self { path: path.to_owned(), name: format!("onnx-{stem}"), network, input, scale, length })
    }
}

impl PictureFeatures for OnnxFeatures {
    fn name(&self) -> &str {
        &self.name
    }

    fn length(&self) -> usize {
        self.length
    }

    fn of(&self, pictures: &Tensor) -> cnerf_core::Result<Vec<Vec<f64>>> {
        let vector = |picture: &image::RgbImage| {
            let scaled = picture::resize(picture, self.input.width as u32, self.input.height as u32)?;
            let vector = contained(PURPOSE, || {
                let input = self.input.tensor(&scaled, self.scale).map_err(one_line)?;
                let outputs = self.network.run(tvec!(input.into())).map_err(one_line)?;
                let output = outputs.first().ok_or("gives no output; give another network")?;
                let output = output.cast_to::<f64>().map_err(one_line)?;
                let view = output.try_as_plain_ram().map_err(one_line)?;
                Ok(view.as_slice::<f64>().map_err(one_line)?.to_vec())
            });
            vector.map_err(|reason| cnerf_core::Error::malformed(&self.path, reason))
        };
        picture::from_tensor(pictures)?.iter().map(vector).collect()
    }
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::parser::{identity_network, mean_network};

    fn load(file: &[u8]) -> Result<OnnxFeatures> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("inception.onnx");
        std::fs::write(&path, file).unwrap();
        OnnxFeatures::load(&path, PixelScale::Unit)
    }

    #[test]
    fn a_picture_becomes_one_vector_and_a_map_is_refused() {
        let features = load(&mean_network(&[1, 3, 16, 16])).unwrap();
        assert_eq!((features.name(), features.length()), ("onnx-inception", 3));
        // Red -1 (byte 0), green 1 (255), blue half and half: means in [0, 1].
        let plane = |value: f32| vec![value; 64];
        let mut values = [plane(-1.0), plane(1.0), plane(-1.0)].concat();
        values[160..].fill(1.0);
        let pictures = Tensor::from_vec(values, (1, 3, 8, 8), &Device::Cpu).unwrap();
        let found = features.of(&pictures).unwrap();
        assert_eq!(found.len(), 1);
        for (found, expected) in found[0].iter().zip([0.0, 1.0, 0.5]) {
            assert!((found - expected).abs() < 0.01, "{found} {expected}");
        }
        let error = load(&identity_network(&[1, 3, 16, 24], false)).err().unwrap().to_string();
        assert!(error.contains("inception.onnx") && error.contains("cut it off after its pooling"), "{error}");
        let error = load(b"nothing").err().unwrap().to_string();
        assert!(error.contains("give a feature network exported to ONNX"), "{error}");
    }
}
