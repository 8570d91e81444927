//! What rendering commands show: which outputs, and how each becomes a picture.

use anyhow::bail;
use candle_core::Tensor;
use clap::ValueEnum;
use cnerf_core::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    model::generator::{Generator, Picture},
    region::RegionSet,
};
use image::{RgbImage, imageops};

/// A picture of a portrait.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum View {
    /// The portrait
    Rgb,
    /// Its regions in their colours
    Seg,
    /// Distance from the camera; near is bright
    Depth,
    /// Surface normals; x, y, z as red, green, blue
    Normal,
}

impl View {
    /// The name used in file names.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rgb => "rgb",
            Self::Seg => "seg",
            Self::Depth => "depth",
            Self::Normal => "normal",
        }
    }
}

/// Depths shown white and black, world units along the view axis.
const DEPTH_SHOWN: [f64; 2] = [0.92, 1.08];

/// Portraits and what is shown of them.
pub struct Scene<'a> {
    /// The generator, tuned if the portrait is a photo's.
    pub generator: &'a Generator,
    /// `[1, 9, 2, D]`.
    pub codes: &'a Tensor,
    /// Drives an upsampler of one global code.
    pub global: Option<&'a Tensor>,
    /// Regions shown.
    pub regions: RegionSet,
}

impl Scene<'_> {
    /// One picture for each of `views`, at the model's output resolution.
    pub fn pictures(&self, camera: &Camera, views: &[View]) -> anyhow::Result<Vec<RgbImage>> {
        let mut settings = self.generator.render_settings();
        settings.regions = self.regions;
        settings.normals |= views.contains(&View::Normal);
        let cameras = Camera::parameter_tensor(&[*camera], &self.generator.device())?;
        let frame = self.generator.render(self.codes, &cameras, &settings)?;
        let lifted = self.generator.upsample(&frame, self.codes, self.global)?;
        let picture = Picture { rgb: lifted.rgb, masks: lifted.masks, frame };
        views.iter().map(|view| self.show(&picture, *view)).collect()
    }

    fn show(&self, picture: &Picture, view: View) -> anyhow::Result<RgbImage> {
        let side = self.generator.output_resolution() as u32;
        let enlarged = |small: RgbImage| imageops::resize(&small, side, side, imageops::FilterType::CatmullRom);
        Ok(match view {
            View::Rgb => first(picture::from_tensor(&picture.rgb)?)?,
            View::Seg => LabelMap::from_masks(&picture.masks.squeeze(0)?)?.colours(),
            View::Depth => {
                let [near, far] = DEPTH_SHOWN;
                // Near to 1, far to -1, as pictures are.
                let shade = picture.frame.depth.affine(-2.0 / (far - near), 1.0 + 2.0 * near / (far - near))?;
                enlarged(first(picture::from_tensor(&shade.clamp(-1.0, 1.0)?.repeat((1, 3, 1, 1))?)?)?)
            }
            View::Normal => match &picture.frame.normal {
                Some(normal) => enlarged(first(picture::from_tensor(normal)?)?),
                None => bail!("--output normal: this model renders no normals"),
            },
        })
    }
}

fn first(pictures: Vec<RgbImage>) -> anyhow::Result<RgbImage> {
    pictures.into_iter().next().ok_or_else(|| anyhow::anyhow!("nothing was rendered"))
}

/// Pictures of one size side by side.
pub fn side_by_side(pictures: &[RgbImage]) -> RgbImage {
    let height = pictures.iter().map(RgbImage::height).max().unwrap_or(0);
    let mut strip = RgbImage::new(pictures.iter().map(RgbImage::width).sum(), height);
    let mut x = 0;
    for picture in pictures {
        imageops::replace(&mut strip, picture, x, 0);
        x += i64::from(picture.width());
    }
    strip
}
