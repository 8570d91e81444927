//! A region in a colour of one's own: its texture code is moved until the region's mean colour is the one asked for.
//!
//! In three parts. Descent on rays of the field, which is cheap, takes the code near: the region recoloured with its
//! own light and shade. Then Newton's steps on the finished picture, upsampler included, each the shortest move of the
//! code that closes what the mean colour still misses. Codes show the colours that the model has seen on people; what
//! is left to another one is a tint, a constant added to the region's colour head: it moves no other region and no
//! surface, and leaves light and shade as they are.

use std::str::FromStr;

use candle_core::Tensor;
use cnerf_core::{
    camera::Camera, codes::Aspect, data::labels::LabelMap, model::generator::Picture, region::Region, rng::Stream,
};
use kornia_image::{Image, ImageError, ImageSize};
use kornia_imgproc::color::lab_from_rgb_f32;
use serde::{Deserialize, Serialize};

use super::displacement::Displacement;
use crate::{
    error::{Error, Result},
    inverter::Opened,
    objective,
    pivot::whole_picture,
    portrait::LARGEST_TINT,
    space::CodeSpace,
};

/// The first element of every stream drawn here.
const STREAM: u64 = 0x636f_6c6f;
/// Steps of descent on rays.
const STEPS: usize = 80;
/// Rays of a step.
const RAYS: usize = 512;
const RATE: f64 = 0.1;
/// Weight of the light and shade within the region: strands stay strands.
const CONTRAST: f64 = 0.5;
/// Holds the codes near where they were.
const HOLD: f64 = 1e-3;
/// Luma, in [0, 1], that is added before light and shade are measured as shares of the mean: what is nearly black has
/// no shading worth stretching.
const SHADE_FLOOR: f64 = 0.1;
/// Most pictures that Newton's steps may take.
const NEWTON_PICTURES: usize = 10;
/// Longest first step, root mean square of the code's whitened coordinates. Hue hangs on the code far more weakly than
/// lightness: steps that mend it are long, and curved in lightness.
const NEWTON_REACH: f64 = 0.1;
/// What becomes of the reach after a step that came nearer, and after one that did not.
const REACH_FACTORS: [f64; 2] = [1.5, 0.4];
/// Most pictures that the tint may take.
const TINT_PICTURES: usize = 8;
/// A perceived difference that is not worth another step.
const CLOSE_ENOUGH: f64 = 0.5;
/// ITU-R BT.601.
const LUMA: [f64; 3] = [0.299, 0.587, 0.114];

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
    let Some(inside) = Inside::of(&picture, region)? else { return Ok(None) };
    inside.mean(&picture.rgb).map(Some)
}

/// Codes `[1, 9, 2, D]` near the portrait's that show `region` in `colour`, from `camera`. Only its texture row moves.
///
/// # Errors
/// [`Error::Core`] if the region does not show from there.
pub fn codes(opened: &Opened, camera: &Camera, region: Region, colour: Colour) -> Result<Tensor> {
    let wanted = colour.0.map(|value| f64::from(value) / 127.5 - 1.0);
    let picture = opened.picture(camera)?;
    let hidden = || Error::config("--color", format!("the portrait shows no {region}; name a region that shows"));
    let finished = Inside::of(&picture, region)?.ok_or_else(hidden)?.mean(&picture.rgb)?;
    let space = CodeSpace::measure(&opened.generator)?;
    let mut search = Displacement::new(&opened.codes, space, region.into(), Aspect::Texture, STEPS, RATE)?;
    descend(&mut search, opened, &picture, camera, region, wanted, finished)?;
    newton(&mut search, opened, camera, region, wanted)?;
    search.codes()
}

/// The tint `[9, 3]`, `tint` but for the row of `region`, with which `opened` shows it in `colour` from `camera`: found
/// by secants, channel by channel. The generator of `opened` keeps the last tint tried.
pub fn tint(opened: &Opened, tint: &Tensor, camera: &Camera, region: Region, colour: Colour) -> Result<Tensor> {
    let wanted = colour.0.map(|value| f64::from(value) / 127.5 - 1.0);
    let mut rows: Vec<Vec<f32>> = tint.to_vec2()?;
    let mut nearest: Option<(f64, Tensor)> = None;
    let mut before: Option<([f64; 3], [f64; 3])> = None;
    // How much of a tint the mean colour shows: all of it, but for pixels shared with other regions or out of range.
    let mut shares = [1.0; 3];
    for _ in 0..TINT_PICTURES {
        let tried = Tensor::new(rows.clone(), tint.device())?;
        opened.set_tint(&tried)?;
        let Some(mean) = mean_colour(opened, camera, region)? else { break };
        let difference = perceived_difference(mean, wanted)?;
        if nearest.as_ref().is_none_or(|(least, _)| difference < *least) {
            nearest = Some((difference, tried));
        }
        let Some(row) = rows.get_mut(region.index()).filter(|_| difference > CLOSE_ENOUGH) else { break };
        let own: [f64; 3] = std::array::from_fn(|channel| row.get(channel).copied().map_or(0.0, f64::from));
        if let Some((own_before, mean_before)) = before {
            for channel in 0..3 {
                let moved = own[channel] - own_before[channel];
                if moved.abs() > 1e-3 {
                    shares[channel] = ((mean[channel] - mean_before[channel]) / moved).clamp(0.2, 2.0);
                }
            }
        }
        for (channel, value) in row.iter_mut().enumerate().take(3) {
            let next = own[channel] + (wanted[channel] - mean[channel]) / shares[channel];
            *value = (next as f32).clamp(-LARGEST_TINT, LARGEST_TINT);
        }
        before = Some((own, mean));
    }
    Ok(nearest.map_or_else(|| tint.clone(), |(_, tint)| tint))
}

/// Takes the code near on rays of the field. What the upsampler adds to the mean is taken to stay what it was:
/// `finished` is the mean of the whole `picture`.
fn descend(
    search: &mut Displacement,
    opened: &Opened,
    picture: &Picture,
    camera: &Camera,
    region: Region,
    wanted: [f64; 3],
    finished: [f64; 3],
) -> Result<()> {
    let device = opened.generator.device();
    let labels = LabelMap::from_masks(&picture.frame.masks.squeeze(0)?)?;
    let inside = pixels_of(&labels, region);
    // Too thin for the render's own pixels: Newton's steps work alone.
    if inside.is_empty() {
        return Ok(());
    }
    let chosen = Tensor::new(inside.as_slice(), &device)?;
    let own = picture.frame.colour.detach().flatten_from(2)?.index_select(&chosen, 2)?;
    let own: Vec<Vec<f32>> = own.squeeze(0)?.to_vec2()?;
    let rendered = means(&own);
    let aim: [f64; 3] =
        std::array::from_fn(|channel| wanted[channel] - (finished[channel] - rendered[channel]).clamp(-0.2, 0.2));
    let aimed = Tensor::new(&aim.map(|value| value as f32), &device)?.reshape((1, 3, 1))?;
    let shade = Tensor::from_vec(shades(&own, aim), (1, 3, inside.len()), &device)?;
    let view = Camera::parameter_tensor(&[*camera], &device)?;
    let resolution = opened.generator.render_resolution();
    let sampling = opened.generator.render_settings().sampling;
    for step in 0..STEPS {
        let mut random = Stream::new(0, &[STREAM, step as u64]);
        let order: Vec<u32> =
            random.permutation(inside.len()).into_iter().take(RAYS).map(|place| place as u32).collect();
        let order = Tensor::new(order.as_slice(), &device)?;
        let pixels = chosen.index_select(&order, 0)?;
        let field = opened.generator.field().portraits(&search.live()?)?;
        let output = objective::render_pixels(&field, &view, &pixels, resolution, &sampling, &mut random)?;
        let mean = output.colour.mean_keepdim(2)?;
        let off = (output.colour.broadcast_sub(&mean)? - shade.index_select(&order, 2)?)?;
        let loss = ((mean - &aimed)?.sqr()?.sum_all()? + (off.sqr()?.mean_all()? * CONTRAST)?)?;
        search.descend(&(loss + (search.distance()? * HOLD)?)?, "the colour's loss")?;
    }
    Ok(())
}

/// Closes what the finished picture's mean colour still misses, and ends at the nearest it found.
fn newton(search: &mut Displacement, opened: &Opened, camera: &Camera, region: Region, wanted: [f64; 3]) -> Result<()> {
    let view = Camera::parameter_tensor(&[*camera], &opened.generator.device())?;
    let mut reach = NEWTON_REACH;
    let mut nearest: Option<Nearest> = None;
    for _ in 0..NEWTON_PICTURES {
        let picture = whole_picture(&opened.generator, &search.live()?, opened.global.as_ref(), &view, true)?;
        let Some(inside) = Inside::of(&picture, region)? else { break };
        let mean = inside.mean(&picture.rgb)?;
        let difference = perceived_difference(mean, wanted)?;
        if nearest.as_ref().is_none_or(|nearest| difference < nearest.difference) {
            let came_nearer = nearest.is_some();
            let missed = std::array::from_fn(|channel| wanted[channel] - mean[channel]);
            let gradients = inside.gradients(&picture.rgb, search)?;
            nearest = Some(Nearest { difference, rows: search.rows()?, missed, gradients });
            reach *= if came_nearer { REACH_FACTORS[0] } else { 1.0 };
        } else {
            reach *= REACH_FACTORS[1];
        }
        let Some(nearest) = nearest.as_ref().filter(|nearest| nearest.difference > CLOSE_ENOUGH) else { break };
        search.set(&nearest.rows)?;
        search.shift(&shortest(&nearest.gradients, nearest.missed, reach)?)?;
    }
    if let Some(nearest) = nearest {
        search.set(&nearest.rows)?;
    }
    Ok(())
}

/// Where the picture came nearest to the colour.
struct Nearest {
    difference: f64,
    rows: Tensor,
    /// What the mean misses, [-1, 1] units.
    missed: [f64; 3],
    /// Of the mean's channels to the rows.
    gradients: [Tensor; 3],
}

/// The step Δ no longer than `reach` (root mean square) that leaves least of `missed` - J Δ: Levenberg's, with as much
/// damping as the reach takes. `gradients` are the rows of J, each as the code's rows are.
fn shortest(gradients: &[Tensor; 3], missed: [f64; 3], reach: f64) -> Result<Tensor> {
    let mut gram = [[0.0; 3]; 3];
    for (row, a) in gradients.iter().enumerate() {
        for (column, b) in gradients.iter().enumerate() {
            gram[row][column] = objective::scalar(&(a * b)?.sum_all()?)?;
        }
    }
    let count = gradients[0].elem_count().max(1) as f64;
    let size = (0..3).map(|index| gram[index][index]).sum::<f64>() / 3.0;
    let mut damping = 1e-6 * size + 1e-12;
    let shares = loop {
        let mut damped = gram;
        (0..3).for_each(|index| damped[index][index] += damping);
        let shares = solve(damped, missed);
        let square =
            (0..3).map(|row| (0..3).map(|column| shares[row] * gram[row][column] * shares[column]).sum::<f64>());
        // Damping far beyond the gradients' size only shortens the step further: the loop ends.
        if (square.sum::<f64>() / count).sqrt() <= reach || damping > 1e6 * size + 1.0 {
            break shares;
        }
        damping *= 2.0;
    };
    let mut step = gradients[0].zeros_like()?;
    for (gradient, share) in gradients.iter().zip(shares) {
        step = (step + (gradient * share)?)?;
    }
    Ok(step)
}

/// Solves a symmetric positive definite system by Cramer's rule.
fn solve(matrix: [[f64; 3]; 3], right: [f64; 3]) -> [f64; 3] {
    let determinant = |m: &[[f64; 3]; 3]| {
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    };
    let whole = determinant(&matrix);
    std::array::from_fn(|column| {
        let mut replaced = matrix;
        replaced.iter_mut().zip(right).for_each(|(row, value)| row[column] = value);
        if whole > 0.0 { determinant(&replaced) / whole } else { 0.0 }
    })
}

/// Where a finished picture shows a region.
struct Inside {
    /// Indices in row order, u32.
    pixels: Tensor,
    count: usize,
}

impl Inside {
    /// None if the region does not show.
    fn of(picture: &Picture, region: Region) -> Result<Option<Self>> {
        let labels = LabelMap::from_masks(&picture.masks.detach().squeeze(0)?)?;
        let pixels = pixels_of(&labels, region);
        let count = pixels.len();
        let pixels = Tensor::new(pixels.as_slice(), picture.masks.device())?;
        Ok((count > 0).then_some(Self { pixels, count }))
    }

    /// Colours `[3, N]` with their graph.
    fn colours(&self, rgb: &Tensor) -> Result<Tensor> {
        Ok(rgb.squeeze(0)?.flatten_from(1)?.index_select(&self.pixels, 1)?)
    }

    fn mean(&self, rgb: &Tensor) -> Result<[f64; 3]> {
        Ok(means(&self.colours(&rgb.detach())?.clamp(-1.0, 1.0)?.to_vec2()?))
    }

    /// Gradients of the three channels' means to the moving rows; pixels beyond [-1, 1] have none.
    fn gradients(&self, rgb: &Tensor, search: &Displacement) -> Result<[Tensor; 3]> {
        let colours = self.colours(rgb)?;
        let within = colours.detach().abs()?.le(1.0)?.to_dtype(colours.dtype())?;
        let shown = (colours * within)?;
        let of = |channel: usize| search.gradient(&(shown.narrow(0, channel, 1)?.sum_all()? / self.count as f64)?);
        Ok([of(0)?, of(1)?, of(2)?])
    }
}

fn pixels_of(labels: &LabelMap, region: Region) -> Vec<u32> {
    let is_inside = |(_, label): &(usize, &u8)| Region::from_label(**label) == Some(region);
    labels.labels().iter().enumerate().filter(is_inside).map(|(index, _)| index as u32).collect()
}

/// The mean of every channel.
fn means(channels: &[Vec<f32>]) -> [f64; 3] {
    let mut means = [0.0; 3];
    for (mean, channel) in means.iter_mut().zip(channels) {
        *mean = channel.iter().map(|value| f64::from(*value)).sum::<f64>() / channel.len().max(1) as f64;
    }
    means
}

/// How far each pixel of `aim`, lit as the `own` colours are, is from `aim` itself: `[3, N]` in row order. Light
/// multiplies: a dark colour has less of it than a bright one.
fn shades(own: &[Vec<f32>], aim: [f64; 3]) -> Vec<f32> {
    let count = own.iter().map(Vec::len).min().unwrap_or(0);
    let unit = |value: f64| (value + 1.0) / 2.0;
    let luma = |index: usize| {
        let parts =
            own.iter().zip(LUMA).map(|(channel, share)| share * channel.get(index).map_or(0.0, |v| f64::from(*v)));
        unit(parts.sum()).clamp(0.0, 1.0)
    };
    let lumas: Vec<f64> = (0..count).map(luma).collect();
    let mean = lumas.iter().sum::<f64>() / count.max(1) as f64;
    let light = |luma: f64| (luma + SHADE_FLOOR) / (mean + SHADE_FLOOR) - 1.0;
    let shade = |value: f64| lumas.iter().map(move |luma| (2.0 * unit(value).max(0.0) * light(*luma)) as f32);
    aim.into_iter().flat_map(shade).collect()
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

    #[test]
    fn the_shortest_step_closes_what_is_missed() {
        let device = candle_core::Device::Cpu;
        let mut random = Stream::new(3, &[]);
        let gradients: [Tensor; 3] = std::array::from_fn(|_| random.normal_tensor(&[1, 16], &device).unwrap());
        let missed = [0.03, -0.02, 0.01];
        let step = shortest(&gradients, missed, 1.0).unwrap();
        for (gradient, missed) in gradients.iter().zip(missed) {
            let closed = objective::scalar(&(gradient * &step).unwrap().sum_all().unwrap()).unwrap();
            // The damping leaves about a millionth; the rest is f32.
            assert!((closed - missed).abs() < 1e-6, "{closed} {missed}");
        }
        let short = shortest(&gradients, missed.map(|value| 1e3 * value), 0.1).unwrap();
        let length = objective::scalar(&short.sqr().unwrap().mean_all().unwrap()).unwrap().sqrt();
        // Damping goes in doublings: never beyond the reach, never far from it.
        assert!((0.04..0.1 + 1e-6).contains(&length), "{length}");
    }

    #[test]
    fn shades_are_those_of_the_own_picture_and_scale_with_the_colour() {
        let own = vec![vec![-0.2f32, 0.2], vec![-0.2, 0.2], vec![-0.2, 0.2]];
        let found = shades(&own, [1.0, 0.0, -1.0]);
        // Lumas 0.4 and 0.6 around 0.5: with the floor, light is 5/6 and 7/6 of the mean's.
        for (found, expected) in found.iter().zip([-2.0 / 6.0, 2.0 / 6.0, -1.0 / 6.0, 1.0 / 6.0, 0.0, 0.0]) {
            assert!((f64::from(*found) - expected).abs() < 1e-5, "{found} {expected}");
        }
    }
}
