//! What rendering commands show: which outputs, and how each becomes a picture.

use anyhow::bail;
use candle_core::Tensor;
use clap::ValueEnum;
use cnerf_core::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    interop::page::PageFrame,
    model::generator::{Generator, Picture},
    region::RegionSet,
    render::{
        RenderSettings,
        plan::{self, FrameReport, Sequence},
    },
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

/// How a pair of views for two eyes is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Stereo {
    /// The left eye's view left, the right eye's right
    Side,
    /// Grey for the left eye in red, colours for the right eye in cyan (red-cyan glasses)
    Anaglyph,
}

/// Half the angle under which a head sees the distance between two eyes, radians: 63 mm at arm's length.
const HALF_EYE_DISTANCE_RAD: f64 = 0.045;

impl Stereo {
    /// The left and the right eye's cameras around `camera`. From the left, one sees more of the head's right: the
    /// camera moves to smaller azimuths.
    pub fn cameras(camera: &Camera) -> [Camera; 2] {
        [-1.0, 1.0].map(|side| Camera { azimuth_rad: camera.azimuth_rad + side * HALF_EYE_DISTANCE_RAD, ..*camera })
    }

    /// Both eyes' pictures as one.
    pub fn join(self, left: &RgbImage, right: &RgbImage) -> RgbImage {
        match self {
            Self::Side => side_by_side(&[left.clone(), right.clone()]),
            // A grey left eye avoids the flicker between eyes that red skin or a blue flag would give.
            Self::Anaglyph => {
                RgbImage::from_fn(left.width().min(right.width()), left.height().min(right.height()), |x, y| {
                    let ([red, green, blue], [_, right_green, right_blue]) =
                        (left.get_pixel(x, y).0, right.get_pixel(x, y).0);
                    let grey = 0.299 * f64::from(red) + 0.587 * f64::from(green) + 0.114 * f64::from(blue);
                    image::Rgb([grey.round() as u8, right_green, right_blue])
                })
            }
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

/// What was shown, and how the render under it was made.
pub struct Shown {
    /// One for each view asked for.
    pub pictures: Vec<RgbImage>,
    /// Its bound and its cost.
    pub report: FrameReport,
}

/// Frames from which shared geometry pays: its grid costs about as much as two exact frames.
const FRAMES_TO_SHARE: usize = 6;

impl Scene<'_> {
    /// What renders need.
    fn settings(&self, normals: bool) -> RenderSettings {
        let mut settings = self.generator.render_settings();
        settings.regions = self.regions;
        settings.normals |= normals;
        settings
    }

    /// Geometry shared by renders from all `cameras`, if there are enough of them; `normals`: whether they show any.
    pub fn sequence(&self, cameras: &[Camera], normals: bool) -> anyhow::Result<Option<Sequence>> {
        if cameras.len() < FRAMES_TO_SHARE {
            return Ok(None);
        }
        let cameras = Camera::parameter_tensor(cameras, &self.generator.device())?;
        let field = self.generator.field().portraits(self.codes)?;
        Ok(Some(Sequence::new(&field, &cameras, &self.settings(normals))?))
    }

    /// One picture for each of `views`, at the model's output resolution; over the geometry of `sequence`, if any.
    pub fn pictures(&self, camera: &Camera, views: &[View], sequence: Option<&Sequence>) -> anyhow::Result<Shown> {
        let (picture, report) = self.picture(camera, views.contains(&View::Normal), sequence)?;
        let pictures = views.iter().map(|view| self.show(&picture, *view)).collect::<anyhow::Result<_>>()?;
        Ok(Shown { pictures, report })
    }

    /// All that a page shows of one view.
    pub fn page_frame(&self, camera: &Camera, sequence: Option<&Sequence>) -> anyhow::Result<(PageFrame, FrameReport)> {
        let (picture, report) = self.picture(camera, true, sequence)?;
        let frame = PageFrame {
            portrait: self.show(&picture, View::Rgb)?,
            depth: self.show(&picture, View::Depth)?,
            normal: self.show(&picture, View::Normal)?,
            labels: LabelMap::from_masks(&picture.masks.squeeze(0)?)?,
        };
        Ok((frame, report))
    }

    fn picture(
        &self,
        camera: &Camera,
        normals: bool,
        sequence: Option<&Sequence>,
    ) -> anyhow::Result<(Picture, FrameReport)> {
        let cameras = Camera::parameter_tensor(&[*camera], &self.generator.device())?;
        let field = self.generator.field().portraits(self.codes)?;
        let planned = match sequence {
            Some(sequence) => sequence.render(&field, &cameras)?,
            None => plan::render(&field, &cameras, &self.settings(normals))?,
        };
        let plan::Planned { frame, report } = planned;
        tracing::info!(
            method = ?report.method,
            bound = report.bound,
            shapes = report.shape_pairs_evaluated,
            textures = report.pairs_evaluated,
            skipped = report.pairs_skipped,
            "rendered"
        );
        let lifted = self.generator.upsample(&frame, self.codes, self.global)?;
        Ok((Picture { rgb: lifted.rgb, masks: lifted.masks, frame }, report))
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

#[cfg(test)]
mod tests {
    use image::Rgb;

    use super::*;

    #[test]
    fn each_eye_gets_its_picture() {
        let [left, right] = Stereo::cameras(&Camera::at(0.2, 0.1));
        assert!(left.azimuth_rad < 0.2 && right.azimuth_rad > 0.2 && left.elevation_rad == 0.1);
        let [left, right] = [[200, 100, 0], [1, 2, 3]].map(|colour| RgbImage::from_pixel(4, 4, Rgb(colour)));
        assert_eq!(Stereo::Anaglyph.join(&left, &right).get_pixel(1, 1).0, [119, 2, 3]);
        let side = Stereo::Side.join(&left, &right);
        assert_eq!(
            (side.dimensions(), side.get_pixel(3, 0).0, side.get_pixel(4, 0).0),
            ((8, 4), [200, 100, 0], [1, 2, 3])
        );
    }
}
