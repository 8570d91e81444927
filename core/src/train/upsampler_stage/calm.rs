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
}

/// Regions that live by their detail: eyes, eyebrows, mouth, nose.
const DETAILED: [Region; 4] = [Region::Eyes, Region::Eyebrows, Region::Mouth, Region::Nose];

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
        let mut plain = background.ones_like()?;
        for region in DETAILED {
            plain = (plain - mask(region)?)?;
        }
        let mean_over = |values: Tensor, area: &Tensor| -> Result<Tensor> {
            // At least a pixel's worth: a square may show none of it.
            Ok(values.mean_keepdim(1)?.mul(area)?.sum_all()?.div(&(area.sum_all()? + 1.0)?)?)
        };
        let curved = laplacian(&added)?.sqr()?;
        Ok(Self { background: mean_over(added.abs()?, &background)?, detail: mean_over(curved, &inner(&plain)?)? })
    }
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
}
