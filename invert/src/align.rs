//! From a detected face to the square crop that the models were trained on: FFHQ's framing.
//!
//! The detector gives a box and no landmarks. A cascade of linear regressors ([`regressor`]), fitted to the training
//! portraits, reads gradients of the crop and moves it until it is framed as they are: centre, scale and roll.
//! A last one reads the head pose, the first guess of the camera.

mod regressor;

use cnerf_core::{camera::Camera, data::labels::LabelMap};
use image::{Rgb, RgbImage};
use serde::{Deserialize, Serialize};

pub use self::regressor::{FEATURES, POSE_OUTPUTS, Regressor, STEP_OUTPUTS, features};
use crate::{
    detect::Face,
    error::Result,
    parser::{Parsed, RegionParser},
};

/// A square cut from a photo, turned about its centre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CropTransform {
    /// Centre from the photo's left edge, pixels.
    pub centre_x: f64,
    /// Centre from the photo's upper edge, pixels.
    pub centre_y: f64,
    /// Half the square's side, pixels of the photo.
    pub half_side: f64,
    /// Angle by which the square is turned clockwise (y points down), radians.
    pub angle_rad: f64,
}

impl CropTransform {
    /// The whole of a picture; of its centre square if it isn't one.
    pub fn whole(photo: &RgbImage) -> Self {
        let (width, height) = (f64::from(photo.width()), f64::from(photo.height()));
        Self { centre_x: width / 2.0, centre_y: height / 2.0, half_side: width.min(height) / 2.0, angle_rad: 0.0 }
    }

    /// The photo's point under a point of the crop; `u`, `v` in [-1, 1], v down.
    pub fn photo_point(&self, u: f64, v: f64) -> (f64, f64) {
        let (sin, cos) = self.angle_rad.sin_cos();
        (self.centre_x + self.half_side * (cos * u - sin * v), self.centre_y + self.half_side * (sin * u + cos * v))
    }

    /// The crop's point, in [-1, 1] when inside, over a point of the photo.
    pub fn crop_point(&self, x: f64, y: f64) -> (f64, f64) {
        let (sin, cos) = self.angle_rad.sin_cos();
        let (dx, dy) = ((x - self.centre_x) / self.half_side, (y - self.centre_y) / self.half_side);
        (cos * dx + sin * dy, cos * dy - sin * dx)
    }

    /// The square moved by a step seen from inside it: right, down (in half sides), ln scale, clockwise radians.
    #[must_use]
    pub fn moved(&self, [right, down, log_scale, turn]: [f64; STEP_OUTPUTS]) -> Self {
        let (centre_x, centre_y) = self.photo_point(right, down);
        Self { centre_x, centre_y, half_side: self.half_side * log_scale.exp(), angle_rad: self.angle_rad + turn }
    }

    /// The step that [`Self::moved`] needs to get from here to `target`.
    pub fn step_to(&self, target: &Self) -> [f64; STEP_OUTPUTS] {
        let (right, down) = self.crop_point(target.centre_x, target.centre_y);
        [right, down, (target.half_side / self.half_side).ln(), target.angle_rad - self.angle_rad]
    }

    /// The crop as a picture of `size` x `size` pixels.
    pub fn cut(&self, photo: &RgbImage, size: u32) -> RgbImage {
        let mut picture = RgbImage::new(size, size);
        for (index, pixel) in picture.pixels_mut().enumerate() {
            let (column, row) = (index as u32 % size.max(1), index as u32 / size.max(1));
            *pixel = Rgb(self.area_mean(photo, column, row, size, 1.0).map(|value| (value + 0.5) as u8));
        }
        picture
    }

    /// Mean colour (0 to 255) under one pixel of a `size` x `size` picture of the crop's inner part of relative
    /// width `extent`. The pixel's square is covered by bilinear samples no further apart than the photo's pixels, so
    /// nothing aliases; beyond the photo's edges the photo is mirrored.
    pub(crate) fn area_mean(&self, photo: &RgbImage, column: u32, row: u32, size: u32, extent: f64) -> [f64; 3] {
        let pixel = 2.0 * extent / f64::from(size);
        let samples = (pixel * self.half_side).ceil().clamp(1.0, 32.0) as u32;
        let mut sum = [0.0; 3];
        for sample in 0..samples * samples {
            let offset = |index: u32| (f64::from(index) + 0.5) / f64::from(samples);
            let u = (f64::from(column) + offset(sample % samples)) * pixel - extent;
            let v = (f64::from(row) + offset(sample / samples)) * pixel - extent;
            let (x, y) = self.photo_point(u, v);
            let colour = bilinear(photo, x - 0.5, y - 0.5);
            (0..3).for_each(|channel| sum[channel] += colour[channel]);
        }
        sum.map(|value| value / f64::from(samples * samples))
    }

    /// Share of the crop that lies beyond the photo's edges, in [0, 1].
    pub fn padded(&self, photo: &RgbImage) -> f64 {
        const GRID: i32 = 64;
        let outside = (0..GRID * GRID).filter(|index| {
            let at = |step: i32| f64::from(2 * step + 1) / f64::from(GRID) - 1.0;
            let (x, y) = self.photo_point(at(index % GRID), at(index / GRID));
            !(0.0..f64::from(photo.width())).contains(&x) || !(0.0..f64::from(photo.height())).contains(&y)
        });
        outside.count() as f64 / f64::from(GRID * GRID)
    }
}

/// A face brought into the training portraits' frame.
#[derive(Clone, Debug)]
pub struct Aligned {
    /// The crop, square.
    pub picture: RgbImage,
    /// Where it lies in the photo.
    pub transform: CropTransform,
    /// The camera the head pose suggests: azimuth, elevation and roll.
    pub camera: Camera,
    /// Share of the crop beyond the photo's edges, mirrored, in [0, 1].
    pub padded: f64,
}

impl Aligned {
    /// The regions `parser` finds in the crop of `photo`. If it reads the head's pose too, the first camera takes its
    /// azimuth and elevation; the roll that alignment read is the better one (0.007 against 0.009 rad off).
    pub fn parse(&mut self, photo: &RgbImage, parser: &dyn RegionParser) -> Result<LabelMap> {
        let Parsed { labels, camera } = parser.parse(&self.transform.cut(photo, parser.side()))?;
        if let Some(camera) = camera {
            self.camera = Camera { roll_rad: self.camera.roll_rad, ..camera };
        }
        Ok(labels)
    }
}

/// Aligns one face of a photo and cuts it at `size` x `size` pixels.
pub fn align(photo: &RgbImage, face: &Face, size: u32) -> Result<Aligned> {
    let regressor = Regressor::embedded()?;
    let transform = regressor.refine(photo, regressor.start(face));
    Ok(cut(photo, transform, regressor.pose(photo, &transform), size))
}

/// Takes a photo that is framed already: its centre square, with the pose read from it.
pub fn already_aligned(photo: &RgbImage, size: u32) -> Result<Aligned> {
    let transform = CropTransform::whole(photo);
    Ok(cut(photo, transform, Regressor::embedded()?.pose(photo, &transform), size))
}

fn cut(photo: &RgbImage, transform: CropTransform, camera: Camera, size: u32) -> Aligned {
    Aligned { picture: transform.cut(photo, size), transform, camera, padded: transform.padded(photo) }
}

/// Colour at pixel coordinates (centres at whole numbers), bilinear, mirrored at the edges.
fn bilinear(photo: &RgbImage, x: f64, y: f64) -> [f64; 3] {
    let (left, top) = (x.floor(), y.floor());
    let (right_share, lower_share) = (x - left, y - top);
    let columns = [left as i64, left as i64 + 1].map(|column| mirrored(column, photo.width()));
    let rows = [top as i64, top as i64 + 1].map(|row| mirrored(row, photo.height()));
    let [a, b, c, d] = [(0, 0), (1, 0), (0, 1), (1, 1)]
        .map(|(column, row): (usize, usize)| photo.get_pixel(columns[column], rows[row]).0.map(f64::from));
    std::array::from_fn(|channel| {
        let upper = a[channel] + right_share * (b[channel] - a[channel]);
        let lower = c[channel] + right_share * (d[channel] - c[channel]);
        upper + lower_share * (lower - upper)
    })
}

/// An index mirrored at both edges of 0..length: -1 becomes 0, length becomes length - 1.
pub(crate) fn mirrored(index: i64, length: u32) -> u32 {
    let length = i64::from(length.max(1));
    let phase = index.rem_euclid(2 * length);
    phase.min(2 * length - 1 - phase) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_and_points_invert() {
        let from = CropTransform { centre_x: 90.0, centre_y: 120.0, half_side: 40.0, angle_rad: 0.3 };
        let to = CropTransform { centre_x: 101.0, centre_y: 99.0, half_side: 55.0, angle_rad: -0.1 };
        let arrived = from.moved(from.step_to(&to));
        for (left, right) in [(arrived.centre_x, to.centre_x), (arrived.half_side, to.half_side)] {
            assert!((left - right).abs() < 1e-9);
        }
        let (x, y) = from.photo_point(0.2, -0.7);
        let (u, v) = from.crop_point(x, y);
        assert!((u - 0.2).abs() < 1e-12 && (v + 0.7).abs() < 1e-12);
    }

    #[test]
    fn a_crop_at_the_photos_own_grid_copies_it_and_mirrors_beyond() {
        let photo = RgbImage::from_fn(8, 8, |x, y| Rgb([(x * 30) as u8, (y * 30) as u8, 7]));
        assert_eq!(CropTransform::whole(&photo).cut(&photo, 8), photo);
        let wide = CropTransform { half_side: 8.0, ..CropTransform::whole(&photo) };
        let picture = wide.cut(&photo, 16);
        assert_eq!(picture.get_pixel(4, 4), photo.get_pixel(0, 0));
        assert_eq!(picture.get_pixel(1, 4), photo.get_pixel(2, 0));
        assert_eq!(wide.padded(&photo), 0.75);
    }

    #[test]
    fn shrinking_averages_instead_of_aliasing() {
        let stripes = RgbImage::from_fn(64, 64, |x, _| Rgb([if x % 2 == 0 { 255 } else { 0 }; 3]));
        let small = CropTransform::whole(&stripes).cut(&stripes, 8);
        assert!(small.pixels().all(|pixel| (120..=135).contains(&pixel.0[0])), "{small:?}");
    }

    #[test]
    fn the_astronaut_is_framed_as_ffhq_frames_her() {
        let path = std::path::Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/photos/astronaut.png"));
        let photo = crate::photo::read(path).unwrap();
        let (face, _) = crate::detect::choose(path, &photo, 0).unwrap();
        let aligned = align(&photo, &face, 256).unwrap();
        // Eyes and mouth read off the photo by hand, FFHQ's quad from them.
        let (eyes, mouth) = ((226.0, 102.0), (224.0, 145.0));
        let (across, down): (f64, f64) = (44.0, 43.0);
        let expected = CropTransform {
            centre_x: eyes.0 + 0.1 * (mouth.0 - eyes.0),
            centre_y: eyes.1 + 0.1 * (mouth.1 - eyes.1),
            half_side: (2.0 * across).max(1.8 * down),
            angle_rad: 0.046,
        };
        let step = aligned.transform.step_to(&expected);
        assert!(step.iter().all(|value| value.abs() < 0.06), "{step:?}");
        assert!(aligned.camera.azimuth_rad.abs() < 0.12 && aligned.padded == 0.0, "{aligned:?}");
    }
}
