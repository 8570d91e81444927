//! Training examples, and what is done to them so that a thousand photos are enough: each is mirrored, moved, turned,
//! scaled, recoloured, blurred, made noisy and covered in part, differently every time it is shown.

use super::{SIDE, network::NUMBERS};
use crate::{
    camera::Camera,
    data::{labels::LabelMap, picture},
    error::Result,
    region::Region,
    rng::Stream,
};
use image::RgbImage;

/// Examples are kept at this width and height: a little more than the network reads, to zoom in.
const KEPT_SIDE: u32 = 160;
/// Standard deviations of turn (radians), ln scale and shift (half widths): imperfect alignment and more.
const TURN_RAD: f32 = 0.09;
const LOG_SCALE: f32 = 0.09;
const SHIFT: f32 = 0.05;
/// Regions of fewer pixels have no centre worth teaching.
const LEAST_PIXELS: usize = 6;

/// A portrait with what is known of it.
#[derive(Clone, Debug)]
pub(super) struct Example {
    picture: RgbImage,
    labels: LabelMap,
    camera: Option<Camera>,
}

/// One portrait as the network is shown it.
pub(super) struct Shown {
    /// `[128, 128, 3]`, in [-1, 1].
    pub colours: Vec<f32>,
    /// `[128, 128]`.
    pub labels: Vec<u8>,
    /// What is known of the numbers.
    pub numbers: [Option<f64>; NUMBERS],
}

impl Example {
    pub fn new(picture: &RgbImage, labels: &LabelMap, camera: Option<Camera>) -> Result<Self> {
        let picture = picture::resize(picture, KEPT_SIDE, KEPT_SIDE)?;
        Ok(Self { picture, labels: labels.resized(KEPT_SIDE, KEPT_SIDE)?, camera })
    }

    /// The example distorted as `random` will have it.
    pub fn show(&self, random: &mut Stream) -> Shown {
        let mirrored = random.chance(0.5);
        let turn = (TURN_RAD * random.normal()).clamp(-0.35, 0.35);
        let scale = (LOG_SCALE * random.normal()).clamp(-0.3, 0.3).exp();
        let shift = [SHIFT * random.normal(), SHIFT * random.normal()];
        let (sin, cos) = turn.sin_cos();
        let (mut colours, mut labels) = (Vec::with_capacity(3 * SIDE * SIDE), Vec::with_capacity(SIDE * SIDE));
        for row in 0..SIDE {
            for column in 0..SIDE {
                let centre = |index: usize| (2 * index + 1) as f32 / SIDE as f32 - 1.0;
                let (u, v) = (if mirrored { -centre(column) } else { centre(column) }, centre(row));
                // The frame is turned clockwise: what is in it turns the other way.
                let x = shift[0] + scale * (cos * u - sin * v);
                let y = shift[1] + scale * (sin * u + cos * v);
                let at = |value: f32| (value + 1.0) * 0.5 * KEPT_SIDE as f32;
                colours.extend(self.colour(at(x) - 0.5, at(y) - 0.5));
                labels.push(self.label(at(x), at(y)));
            }
        }
        recolour(&mut colours, random);
        if random.chance(0.3) {
            (0..=random.below(3)).for_each(|_| blur(&mut colours));
        }
        if random.chance(0.3) {
            let deviation = random.range(0.01, 0.12);
            colours.iter_mut().for_each(|value| *value += deviation * random.normal());
        }
        if random.chance(0.15) {
            cover(&mut colours, random);
        }
        colours.iter_mut().for_each(|value| *value = value.clamp(-1.0, 1.0));
        let numbers = self.numbers(mirrored, f64::from(turn), &labels);
        Shown { colours, labels, numbers }
    }

    /// Bilinear, mirrored at the edges; in [0, 1].
    fn colour(&self, x: f32, y: f32) -> [f32; 3] {
        let (left, top) = (x.floor(), y.floor());
        let (right, low) = (x - left, y - top);
        let pixel = |dx: i32, dy: i32| {
            self.picture.get_pixel(mirrored_index(left as i32 + dx), mirrored_index(top as i32 + dy)).0
        };
        let [a, b, c, d] = [pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1)];
        std::array::from_fn(|channel| {
            let [a, b, c, d] = [a, b, c, d].map(|pixel| f32::from(pixel[channel]) / 255.0);
            let (upper, lower) = (a + right * (b - a), c + right * (d - c));
            upper + low * (lower - upper)
        })
    }

    fn label(&self, x: f32, y: f32) -> u8 {
        let (column, row) = (mirrored_index(x.floor() as i32), mirrored_index(y.floor() as i32));
        self.labels.labels().get((row * KEPT_SIDE + column) as usize).copied().unwrap_or_default()
    }

    fn numbers(&self, mirrored: bool, turn_rad: f64, labels: &[u8]) -> [Option<f64>; NUMBERS] {
        let pose = self.camera.map(|camera| {
            let turned = Camera { roll_rad: camera.roll_rad - turn_rad, ..camera };
            if mirrored { turned.mirrored() } else { turned }
        });
        let eyes = eyes(labels);
        let mouth = centre(labels.iter().enumerate().filter(|(_, label)| **label == Region::Mouth as u8));
        let [azimuth, elevation, roll] =
            [pose.map(|pose| pose.azimuth_rad), pose.map(|pose| pose.elevation_rad), pose.map(|pose| pose.roll_rad)];
        let eye = |which: usize, axis: usize| eyes.map(|eyes| eyes[which][axis]);
        let mouth = |axis: usize| mouth.map(|mouth| mouth[axis]);
        [azimuth, elevation, roll, eye(0, 0), eye(0, 1), eye(1, 0), eye(1, 1), mouth(0), mouth(1)]
    }
}

/// What is known of the pose and of the points when nothing is distorted.
#[cfg(test)]
impl Example {
    fn undistorted(&self) -> super::Numbers {
        let labels = self.labels.resized(SIDE as u32, SIDE as u32).unwrap();
        super::Numbers(self.numbers(false, 0.0, labels.labels()).map(Option::unwrap))
    }
}

/// An index mirrored at both edges.
fn mirrored_index(index: i32) -> u32 {
    let length = KEPT_SIDE as i32;
    let phase = index.rem_euclid(2 * length);
    phase.min(2 * length - 1 - phase) as u32
}

/// The mean place of pixels of a [`SIDE`]² map, right and down in half widths; none if they are too few.
fn centre<'a>(pixels: impl Iterator<Item = (usize, &'a u8)>) -> Option<[f64; 2]> {
    let (mut sum, mut count) = ([0.0; 2], 0usize);
    for (index, _) in pixels {
        sum[0] += (index % SIDE) as f64 + 0.5;
        sum[1] += (index / SIDE) as f64 + 0.5;
        count += 1;
    }
    (count >= LEAST_PIXELS).then(|| sum.map(|sum| 2.0 * sum / (count as f64 * SIDE as f64) - 1.0))
}

/// The centres of the two largest pieces of the eye region, the left one first; none unless there are two.
fn eyes(labels: &[u8]) -> Option<[[f64; 2]; 2]> {
    let eye = Region::Eyes as u8;
    let mut seen = vec![false; labels.len()];
    let mut pieces: Vec<Vec<usize>> = Vec::new();
    for start in 0..labels.len() {
        if labels[start] != eye || seen[start] {
            continue;
        }
        seen[start] = true;
        let (mut piece, mut next) = (vec![start], 0);
        while let Some(&index) = piece.get(next) {
            next += 1;
            let (x, y) = (index % SIDE, index / SIDE);
            let around = [(x > 0, index.wrapping_sub(1)), (x + 1 < SIDE, index + 1)];
            let above = [(y > 0, index.wrapping_sub(SIDE)), (y + 1 < SIDE, index + SIDE)];
            for (_, other) in around.into_iter().chain(above).filter(|(inside, _)| *inside) {
                if labels.get(other) == Some(&eye) && !seen[other] {
                    seen[other] = true;
                    piece.push(other);
                }
            }
        }
        pieces.push(piece);
    }
    pieces.sort_by_key(|piece| std::cmp::Reverse(piece.len()));
    let middle = |piece: &Vec<usize>| centre(piece.iter().map(|&index| (index, &eye)));
    let (first, second) = (middle(pieces.first()?)?, middle(pieces.get(1)?)?);
    Some(if first[0] <= second[0] { [first, second] } else { [second, first] })
}

/// Gamma, contrast, brightness, saturation and the light's colour; [0, 1] becomes [-1, 1].
fn recolour(colours: &mut [f32], random: &mut Stream) {
    let gamma = (0.3 * random.normal()).clamp(-0.9, 0.9).exp();
    let contrast = (0.15 * random.normal()).clamp(-0.5, 0.5).exp();
    let brightness = 0.07 * random.normal();
    let saturation = if random.chance(0.06) { 0.0 } else { (0.25 * random.normal()).clamp(-0.8, 0.8).exp() };
    let light: [f32; 3] = std::array::from_fn(|_| (0.07 * random.normal()).exp());
    for pixel in colours.chunks_exact_mut(3) {
        let grey = (pixel[0] + pixel[1] + pixel[2]) / 3.0;
        for (value, light) in pixel.iter_mut().zip(light) {
            let coloured = (grey + saturation * (*value - grey)).clamp(0.0, 1.0).powf(gamma) * light;
            *value = 2.0 * ((coloured - 0.5) * contrast + brightness);
        }
    }
}

/// Binomial blur over 3×3 pixels, edges repeated.
fn blur(colours: &mut [f32]) {
    for step in [3, 3 * SIDE] {
        let before = colours.to_vec();
        let lines = if step == 3 { 3 * SIDE } else { colours.len() };
        for (index, value) in colours.iter_mut().enumerate() {
            let within = index % lines;
            let lower = if within >= step { before[index - step] } else { before[index] };
            let upper = if within + step < lines { before[index + step] } else { before[index] };
            *value = 0.25 * (lower + upper) + 0.5 * before[index];
        }
    }
}

/// Hides a rectangle behind one colour: a microphone, a hand, a caption. What lies behind it stays what it is.
fn cover(colours: &mut [f32], random: &mut Stream) {
    let (width, height) = (4 + random.below(SIDE / 4), 4 + random.below(SIDE / 4));
    let (left, top) = (random.below(SIDE - width), random.below(SIDE - height));
    let colour: [f32; 3] = std::array::from_fn(|_| random.range(-1.0, 1.0));
    for row in colours.chunks_exact_mut(3 * SIDE).skip(top).take(height) {
        for pixel in row.chunks_exact_mut(3).skip(left).take(width) {
            pixel.copy_from_slice(&colour);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parsing::Numbers;

    /// Two eyes and a mouth on grey; the left eye is red, so that its place can be found again in the colours.
    fn face() -> Example {
        let mut labels = vec![Region::Face as u8; 256 * 256];
        let mut picture = RgbImage::from_pixel(256, 256, image::Rgb([90, 90, 90]));
        for (left, top, region) in [(80, 110, Region::Eyes), (150, 110, Region::Eyes), (110, 190, Region::Mouth)] {
            for index in 0..24 * 24 {
                let (x, y) = (left + index % 24, top + index / 24);
                labels[y * 256 + x] = region as u8;
                if left == 80 {
                    picture.put_pixel(x as u32, y as u32, image::Rgb([250, 20, 20]));
                }
            }
        }
        let camera = Camera { roll_rad: 0.1, ..Camera::at(0.3, -0.1) };
        Example::new(&picture, &LabelMap::new(256, 256, labels).unwrap(), Some(camera)).unwrap()
    }

    #[test]
    fn points_and_pose_move_with_the_picture() {
        let example = face();
        let plain = example.undistorted();
        let expected = [0.3, -0.1, 0.1, -0.281, -0.047, 0.266, -0.047, -0.047, 0.578];
        for (found, expected) in plain.0.iter().zip(expected) {
            assert!((found - expected).abs() < 0.02, "{plain:?}");
        }
        let mut mirrored_once = false;
        for seed in 0..20 {
            let shown = example.show(&mut Stream::new(seed, &[]));
            let numbers = Numbers(shown.numbers.map(Option::unwrap));
            let mirrored = numbers.0[0] < 0.0;
            mirrored_once |= mirrored;
            let upright = if mirrored { numbers.mirrored() } else { numbers };
            // The line between the eyes turns as the picture does: clockwise with a rise of the roll.
            let slope = (upright.0[6] - upright.0[4]).atan2(upright.0[5] - upright.0[3]);
            assert!((slope - (upright.0[2] - 0.1)).abs() < 0.03, "{slope} {upright:?}");
            assert!(shown.labels.iter().filter(|label| **label == Region::Eyes as u8).count() > 100);
        }
        assert!(mirrored_once);
    }

    #[test]
    fn one_eye_is_no_pair() {
        let mut labels = vec![0; SIDE * SIDE];
        (0..20).for_each(|x| labels[50 * SIDE + 40 + x] = Region::Eyes as u8);
        assert_eq!(eyes(&labels), None);
        (0..8).for_each(|x| labels[50 * SIDE + 90 + x] = Region::Eyes as u8);
        let [left, right] = eyes(&labels).unwrap();
        assert!(left[0] < right[0] && (left[0] - (-0.21875)).abs() < 1e-9, "{left:?}");
    }

    #[test]
    fn blurring_takes_the_finest_stripes_away() {
        let mut colours: Vec<f32> =
            (0..3 * SIDE * SIDE).map(|index| if index / 3 % 2 == 0 { 1.0 } else { -1.0 }).collect();
        blur(&mut colours);
        let inner: Vec<f32> = colours.chunks_exact(3 * SIDE).flat_map(|row| row[6..3 * SIDE - 6].to_vec()).collect();
        assert!(inner.iter().all(|value| value.abs() < 1e-6));
    }
}
