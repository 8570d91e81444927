//! A region in a colour of one's own: its texture code is moved until the region's mean colour is the one asked for.
//!
//! Descent runs on rays of the field, which is cheap; the finished picture differs from the field's by what the
//! upsampler adds, so the aim is corrected by that difference between rounds.

use std::str::FromStr;

use candle_core::Tensor;
use cnerf_core::{camera::Camera, codes::Aspect, data::labels::LabelMap, region::Region, rng::Stream};
use kornia_image::{Image, ImageError, ImageSize};
use kornia_imgproc::color::lab_from_rgb_f32;
use serde::{Deserialize, Serialize};

use super::displacement::Displacement;
use crate::{
    error::{Error, Result},
    inverter::Opened,
    objective,
    space::CodeSpace,
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x636f_6c6f;
/// Rounds, each with its aim corrected by what the picture before it missed.
const ROUNDS: usize = 3;
const STEPS: usize = 40;
/// Rays of a step.
const RAYS: usize = 512;
const RATE: f64 = 0.1;
/// Weight of the light and shade within the region, held to the portrait's own: strands stay strands.
const CONTRAST: f64 = 0.5;
/// Holds the codes near where they were.
const HOLD: f64 = 1e-3;

/// An sRGB colour, written `#7a3b12`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Colour(pub [u8; 3]);

impl FromStr for Colour {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let digits = text.strip_prefix('#').unwrap_or(text);
        let sound = digits.len() == 6 && digits.bytes().all(|byte| byte.is_ascii_hexdigit());
        let value = u32::from_str_radix(digits, 16).ok().filter(|_| sound);
        let value =
            value.ok_or_else(|| Error::config("colour", format!("`{text}` is no colour; write one as #7a3b12")))?;
        Ok(Self([(value >> 16) as u8, (value >> 8) as u8, value as u8]))
    }
}

impl std::fmt::Display for Colour {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [red, green, blue] = self.0;
        write!(f, "#{red:02x}{green:02x}{blue:02x}")
    }
}

impl TryFrom<String> for Colour {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl From<Colour> for String {
    fn from(colour: Colour) -> Self {
        colour.to_string()
    }
}

/// How far two colours in [-1, 1] are apart to the eye: the distance in CIE L*a*b* (CIE76 ΔE; 2 is just seen, 10 is
/// plain).
pub fn perceived_difference(a: [f64; 3], b: [f64; 3]) -> Result<f64> {
    let size = ImageSize { width: 2, height: 1 };
    let unit: Vec<f32> = a.into_iter().chain(b).map(|value| ((value + 1.0) / 2.0).clamp(0.0, 1.0) as f32).collect();
    let convert = || -> Result<Vec<f32>, ImageError> {
        let mut lab = Image::<f32, 3>::from_size_val(size, 0.0)?;
        lab_from_rgb_f32(&Image::<f32, 3>::new(size, unit)?, &mut lab)?;
        Ok(lab.into_vec())
    };
    let lab = convert().map_err(|error| Error::config("colour", error))?;
    let square = lab.iter().take(3).zip(lab.iter().skip(3)).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>();
    Ok(square.sqrt())
}

/// The mean colour in [-1, 1] of `region` in the portrait's finished picture from `camera`; none if it does not show.
pub fn mean_colour(opened: &Opened, camera: &Camera, region: Region) -> Result<Option<[f64; 3]>> {
    let picture = opened.picture(camera)?;
    let labels = LabelMap::from_masks(&picture.masks.squeeze(0)?)?;
    let rgb: Vec<Vec<f32>> = picture.rgb.clamp(-1.0, 1.0)?.squeeze(0)?.flatten_from(1)?.to_vec2()?;
    let inside: Vec<usize> = (0..labels.labels().len())
        .filter(|index| labels.labels().get(*index).copied().and_then(Region::from_label) == Some(region))
        .collect();
    if inside.is_empty() {
        return Ok(None);
    }
    let mut mean = [0.0; 3];
    for (sum, plane) in mean.iter_mut().zip(&rgb) {
        *sum = inside.iter().filter_map(|index| plane.get(*index)).map(|value| f64::from(*value)).sum::<f64>()
            / inside.len() as f64;
    }
    Ok(Some(mean))
}

/// Codes `[1, 9, 2, D]` near the portrait's that show `region` in `colour`, from `camera`. Only its texture row moves.
///
/// # Errors
/// [`Error::Core`] if the region does not show from there.
pub fn codes(opened: &Opened, camera: &Camera, region: Region, colour: Colour) -> Result<Tensor> {
    let wanted = colour.0.map(|value| f64::from(value) / 127.5 - 1.0);
    let device = opened.generator.device();
    let resolution = opened.generator.render_resolution();
    let frame = opened.picture(camera)?.frame;
    let labels = LabelMap::from_masks(&frame.masks.squeeze(0)?)?;
    let inside: Vec<u32> = (0..labels.labels().len() as u32)
        .filter(|index| labels.labels().get(*index as usize).copied().and_then(Region::from_label) == Some(region))
        .collect();
    if inside.is_empty() {
        return Err(Error::config("--color", format!("the portrait shows no {region}; name a region that shows")));
    }
    let own = frame.colour.detach().flatten_from(2)?;
    let own_mean = own.index_select(&Tensor::new(inside.as_slice(), &device)?, 2)?.mean_keepdim(2)?;
    let view = Camera::parameter_tensor(&[*camera], &device)?;
    let sampling = opened.generator.render_settings().sampling;
    let space = CodeSpace::measure(&opened.generator)?;
    let mut search = Displacement::new(&opened.codes, space, region.into(), Aspect::Texture, ROUNDS * STEPS, RATE)?;
    let mut aim = wanted;
    for round in 0..ROUNDS {
        let target = Tensor::new(&aim.map(|value| value as f32), &device)?.reshape((1, 3, 1))?;
        for step in 0..STEPS {
            let mut random = Stream::new(0, &[STREAM, (round * STEPS + step) as u64]);
            let order = random.permutation(inside.len()).into_iter().take(RAYS);
            let chosen: Vec<u32> = order.filter_map(|index| inside.get(index).copied()).collect();
            let pixels = Tensor::new(chosen.as_slice(), &device)?;
            let field = opened.generator.field().portraits(&search.live()?)?;
            let output = objective::render_pixels(&field, &view, &pixels, resolution, &sampling, &mut random)?;
            let mean = output.colour.mean_keepdim(2)?;
            let shade = output.colour.broadcast_sub(&mean)?;
            let own_shade = own.index_select(&pixels, 2)?.broadcast_sub(&own_mean)?;
            let loss = ((mean - &target)?.sqr()?.sum_all()? + ((shade - own_shade)?.sqr()?.mean_all()? * CONTRAST)?)?;
            search.descend(&(loss + (search.distance()? * HOLD)?)?, "the colour's loss")?;
        }
        let found = Opened { codes: search.codes()?, ..opened.clone() };
        if let Some(found) = mean_colour(&found, camera, region)? {
            (0..3).for_each(|channel| aim[channel] += wanted[channel] - found[channel]);
            aim = aim.map(|value| value.clamp(-1.2, 1.2));
        }
    }
    search.codes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_are_read_as_the_web_writes_them() {
        assert_eq!("#7a3B12".parse::<Colour>().unwrap(), Colour([0x7a, 0x3b, 0x12]));
        assert_eq!(Colour([1, 171, 255]).to_string(), "#01abff");
        for wrong in ["", "#7a3b1", "#7a3b1g", "red", "#7a3b1234", "+7a3b1"] {
            assert!(wrong.parse::<Colour>().unwrap_err().to_string().contains("#7a3b12"), "{wrong}");
        }
    }

    #[test]
    fn differences_are_those_of_cie_lab() {
        // sRGB red is L* 53.24, a* 80.09, b* 67.20 (D65); black is the origin; white is L* 100.
        let red: f64 = 53.24f64.hypot(80.09).hypot(67.20);
        for (colour, expected) in [([1.0, -1.0, -1.0], red), ([1.0, 1.0, 1.0], 100.0), ([-1.0; 3], 0.0)] {
            let found = perceived_difference(colour, [-1.0; 3]).unwrap();
            assert!((found - expected).abs() < 0.05, "{colour:?}: {found} {expected}");
        }
    }
}
