//! Feature vectors of whole pictures, by which sets of pictures are compared: the last feature map of an LPIPS
//! backbone, averaged over the picture, or whatever else implements [`PictureFeatures`].
//!
//! Distances in LPIPS's features rank models and settings against each other, and against the floor and the blur reference
//! that are measured beside them; they are not comparable with published ones, which use Inception's: no package carries
//! its weights, who has them exported to ONNX can use them (`OnnxFeatures` in `cnerf-invert`).

use std::path::Path;

use candle_core::{DType, Device, Tensor};

use super::perceptual::{Backbone, Perceptual};
use crate::error::{Error, Result};

/// A network that sums a picture up in a vector.
pub trait PictureFeatures {
    /// The name in reports.
    fn name(&self) -> &str;

    /// Numbers in a vector.
    fn length(&self) -> usize;

    /// The vectors of pictures `[B, 3, H, W]` in [-1, 1].
    fn of(&self, pictures: &Tensor) -> Result<Vec<Vec<f64>>>;

    /// The perceptual distance whose backbone this is, if it is one's.
    fn perceptual(&self) -> Option<&Perceptual> {
        None
    }
}

/// The last feature map of an LPIPS backbone, averaged over the picture.
#[derive(Clone, Debug)]
pub struct PooledFeatures {
    perceptual: Perceptual,
}

impl PooledFeatures {
    /// Reads LPIPS weights (AlexNet or VGG16, told by their shapes) from a safetensors file.
    ///
    /// # Errors
    /// Names the file if it cannot be read or holds something else, e.g. Inception's weights.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self> {
        Ok(Self { perceptual: Perceptual::load(path, device)? })
    }
}

impl PictureFeatures for PooledFeatures {
    /// `lpips-alexnet-relu5` (256 numbers) or `lpips-vgg16-relu5_3` (512).
    fn name(&self) -> &str {
        match self.perceptual.backbone() {
            Backbone::AlexNet => "lpips-alexnet-relu5",
            Backbone::Vgg16 => "lpips-vgg16-relu5_3",
        }
    }

    fn length(&self) -> usize {
        let [.., last] = self.perceptual.backbone().channels();
        last
    }

    fn perceptual(&self) -> Option<&Perceptual> {
        Some(&self.perceptual)
    }

    fn of(&self, pictures: &Tensor) -> Result<Vec<Vec<f64>>> {
        let maps = self.perceptual.features(&pictures.detach())?;
        let last = maps.last().ok_or_else(|| Error::shape("feature maps", "five", &[0]))?;
        Ok(last.to_dtype(DType::F64)?.mean((2, 3))?.to_device(&Device::Cpu)?.to_vec2()?)
    }
}
