//! A portrait to be measured: a random one of a model, or an inverted photo with its tuned generator.

use candle_core::Tensor;

use crate::{
    camera::Camera,
    error::Result,
    model::generator::{Generator, Picture},
    rng::Stream,
};

/// The first element of the streams that cameras are drawn from.
const CAMERAS: u64 = 0x6361_6d65;
/// Standard deviations of azimuth and elevation where a data set names no cameras, radians (design.md: photos).
const CAMERA_DEVIATIONS_RAD: [f64; 2] = [0.3, 0.15];

/// A portrait and the camera it is first seen from.
#[derive(Clone)]
pub struct Subject<'a> {
    /// The generator, tuned if the portrait is a photo's.
    pub generator: &'a Generator,
    /// `[1, 9, 2, D]`.
    pub codes: Tensor,
    /// Drives an upsampler of one global code.
    pub global: Option<Tensor>,
    /// Where it is seen from.
    pub camera: Camera,
}

impl<'a> Subject<'a> {
    /// The random portrait that `cnerf generate --seeds SEED --trunc TRUNCATION` shows.
    pub fn random(generator: &'a Generator, seed: u64, truncation: f64, camera: Camera) -> Result<Self> {
        Ok(Self { generator, codes: generator.codes_from_seed(seed, truncation)?.detach(), global: None, camera })
    }

    /// The finished picture from `camera`, colours clamped to [-1, 1], no graph attached.
    pub fn picture(&self, camera: &Camera) -> Result<Picture> {
        picture_of(self.generator, &self.codes, self.global.as_ref(), camera)
    }
}

/// The finished picture of one portrait, see [`Subject::picture`].
pub fn picture_of(generator: &Generator, codes: &Tensor, global: Option<&Tensor>, camera: &Camera) -> Result<Picture> {
    let view = Camera::parameter_tensor(&[*camera], &generator.device())?;
    let frame = generator.render(codes, &view, &generator.render_settings())?;
    let lifted = generator.upsample(&frame, codes, global)?;
    Ok(Picture { rgb: lifted.rgb.detach().clamp(-1.0, 1.0)?, masks: lifted.masks.detach(), frame })
}

/// A camera as photos have them, for data that names none: Gaussian angles.
pub fn photo_camera(seed: u64, index: u64) -> Camera {
    let mut random = Stream::new(seed, &[CAMERAS, index]);
    let [azimuth, elevation] = CAMERA_DEVIATIONS_RAD.map(|deviation| deviation * f64::from(random.normal()));
    Camera::at(azimuth.clamp(-0.9, 0.9), elevation.clamp(-0.45, 0.45))
}
