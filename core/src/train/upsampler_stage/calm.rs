//! What keeps random portraits free of patterns, strokes and specks: their detail is taught by other portraits' photos.

use candle_core::Tensor;

use crate::{
    error::Result,
    model::{layers::Resampling, upsampler::UpsamplerOutput},
    region::Region,
};

/// What random pictures add to their enlarged renders where nothing tells what to add.
pub(super) struct Calm {
    /// Mean absolute difference over the background.
    pub background: Tensor,
    /// Mean squared Laplacian of the difference over all but [`DETAILED`]: a lone dark pixel costs sixteen times its
    /// square, a shade over several pixels next to nothing.
    pub detail: Tensor,
    /// The same around outlines, where the head's parts and the background meet: rows of dark dashes like to stand there.
    pub outline: Tensor,
}

/// Regions that live by their detail: eyes, eyebrows, mouth, nose.
const DETAILED: [Region; 4] = [Region::Eyes, Region::Eyebrows, Region::Mouth, Region::Nose];
/// An outline is as broad as this to either side, pixels.
const OUTLINE_REACH: usize = 4;

impl Calm {
    /// Of pictures and their renders `[B, 3, r, r]`.
    pub fn of(picture: &UpsamplerOutput, render: &Tensor) -> Result<Self> {
        let mut enlarged = render.clone();
        while enlarged.dim(3)? < picture.rgb.dim(3)? {
            enlarged = Resampling::BilinearUp.apply(&enlarged)?;
        }
        let added = (&picture.rgb - enlarged)?;
        let masks = picture.masks.detach();
        let mask = |region: Region| masks.narrow(1, region as usize, 1);
        let background = mask(Region::Background)?;
        let mut detailed = background.zeros_like()?;
        for region in DETAILED {
            detailed = (detailed + mask(region)?)?;
        }
        let plain = detailed.affine(-1.0, 1.0)?;
        let outline = (outline(&masks, &detailed)? * &plain)?;
        let mean_over = |values: Tensor, area: &Tensor| -> Result<Tensor> {
            // At least a pixel's worth: a square may show none of it.
            Ok(values.mean_keepdim(1)?.mul(area)?.sum_all()?.div(&(area.sum_all()? + 1.0)?)?)
        };
        let curved = laplacian(&added)?.sqr()?;
        Ok(Self {
            background: mean_over(added.abs()?, &background)?,
            outline: mean_over(curved.clone(), &inner(&outline)?)?,
            detail: mean_over(curved, &inner(&plain)?)?,
        })
    }
}

/// 1 along the lines where regions meet, 0 away from them, `[B, 1, H, W]`; `detailed` regions count as face.
fn outline(masks: &Tensor, detailed: &Tensor) -> Result<Tensor> {
    let mask = |region: Region| masks.narrow(1, region as usize, 1);
    let mut squares = (mask(Region::Face)? + detailed)?.sqr()?;
    for region in [Region::Background, Region::Ears, Region::Hair, Region::Neck] {
        squares = (squares + mask(region)?.sqr()?)?;
    }
    // Where one region has it all, the squares of the shares sum to 1.
    let mixed = squares.affine(-1.0, 1.0)?;
    let mixed = mixed.pad_with_same(2, OUTLINE_REACH, OUTLINE_REACH)?.pad_with_same(3, OUTLINE_REACH, OUTLINE_REACH)?;
    let side = 2 * OUTLINE_REACH + 1;
    let share = mixed.contiguous()?.avg_pool2d_with_stride((side, side), (1, 1))?;
    // A line a pixel wide, half one region's and half another's, crosses `side` of the square's pixels.
    Ok((share * (2 * side) as f64)?.clamp(0.0, 1.0)?)
}

/// All but the outermost pixels.
fn inner(picture: &Tensor) -> Result<Tensor> {
    let (_, _, height, width) = picture.dims4()?;
    Ok(picture.narrow(2, 1, height - 2)?.narrow(3, 1, width - 2)?)
}

/// Each inner pixel's four neighbours less four times itself, `[B, C, H - 2, W - 2]`.
fn laplacian(picture: &Tensor) -> Result<Tensor> {
    let (_, _, height, width) = picture.dims4()?;
    let rows = |from: usize| picture.narrow(2, from, height - 2)?.narrow(3, 1, width - 2);
    let columns = |from: usize| picture.narrow(2, 1, height - 2)?.narrow(3, from, width - 2);
    let around = (((rows(0)? + rows(2)?)? + columns(0)?)? + columns(2)?)?;
    Ok((around - (inner(picture)? * 4.0)?)?)
}

#[cfg(test)]
mod tests {
    use candle_core::{DType, Device};

    use super::*;

    #[test]
    fn specks_cost_and_shades_and_eyes_do_not() {
        let render = Tensor::zeros((1, 3, 8, 8), DType::F32, &Device::Cpu).unwrap();
        let cost = |region: Region, added: &dyn Fn(usize, usize) -> f32| {
            let picture: Vec<f32> = (0..3 * 256).map(|at| added(at / 16 % 16, at % 16)).collect();
            let masks: Vec<f32> = (0..9 * 256).map(|at| f32::from(at / 256 == region as usize)).collect();
            let output = UpsamplerOutput {
                rgb: Tensor::from_vec(picture, (1, 3, 16, 16), &Device::Cpu).unwrap(),
                masks: Tensor::from_vec(masks, (1, 9, 16, 16), &Device::Cpu).unwrap(),
            };
            let calm = Calm::of(&output, &render).unwrap();
            assert_eq!(calm.outline.to_scalar::<f32>().unwrap(), 0.0, "one region has no outlines");
            (calm.background.to_scalar::<f32>().unwrap(), calm.detail.to_scalar::<f32>().unwrap())
        };
        let speck = |row: usize, column: usize| if (row, column) == (8, 7) { -0.3 } else { 0.0 };
        let shade = |row: usize, column: usize| 0.02 * (row + column) as f32;
        // Four times the speck at its pixel and once at each neighbour, squared, over 14² inner pixels and one.
        let (background, detail) = cost(Region::Hair, &speck);
        assert_eq!(background, 0.0);
        assert!((detail - 20.0 * 0.09 / 197.0).abs() < 1e-6, "{detail}");
        assert!(cost(Region::Hair, &shade).1 < 1e-9);
        assert_eq!(cost(Region::Eyes, &speck).1, 0.0);
        let (background, detail) = cost(Region::Background, &speck);
        assert!((background - 0.3 / 257.0).abs() < 1e-6 && detail > 0.0, "{background} {detail}");
    }

    #[test]
    fn outlines_are_where_regions_meet_and_eyes_have_none() {
        // Hair to the left of column 8, face to the right, an eye in its middle.
        let region = |row: usize, column: usize| match (row, column) {
            (_, 0..8) => Region::Hair,
            (7..9, 23..25) => Region::Eyes,
            _ => Region::Face,
        };
        let masks: Vec<f32> =
            (0..9 * 512).map(|at| f32::from(at / 512 == region(at % 512 / 32, at % 32) as usize)).collect();
        let masks = Tensor::from_vec(masks, (1, 9, 16, 32), &Device::Cpu).unwrap();
        // Finished masks are enlarged ones: no line is sharper than two pixels.
        let masks = Resampling::BilinearUp.apply(&masks).unwrap();
        let eyes = masks.narrow(1, Region::Eyes as usize, 1).unwrap();
        let found = outline(&masks, &eyes).unwrap().squeeze(0).unwrap().squeeze(0).unwrap().to_vec2::<f32>().unwrap();
        assert_eq!((found.len(), found[0].len()), (32, 64));
        assert!(found.iter().all(|row| row[13] > 0.9 && row[18] > 0.9), "{:?}", found[16]);
        assert!(found.iter().all(|row| row[4] == 0.0 && row[28..].iter().all(|value| value.abs() < 1e-5)));
    }
}
