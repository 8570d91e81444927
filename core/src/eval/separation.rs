//! How far shape and texture codes keep to their own: the paper's ablation of L_STD (shape-texture decoupling) as
//! numbers. All regions' shape codes, or all their texture codes, are swapped for another portrait's; what changes is
//! compared with what changes when both are.

use candle_core::{DType, Device, Tensor};
use serde::Serialize;

use super::subject::Subject;
use crate::{
    codes::{self, Aspect},
    error::Result,
    model::generator::Picture,
    region::{REGION_COUNT, RegionSet},
};

/// A region is compared by its mean colour where both pictures show this many pixels of it.
const LEAST_PIXELS: f64 = 4.0;

/// How much two pictures of one view differ; mean absolute differences.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Difference {
    /// Rendered masks.
    masks: f64,
    /// World units.
    depth: f64,
    /// Finished pictures.
    colour: f64,
    /// Mean colours of the regions, wherever they lie.
    region_colour: f64,
    /// Rendered features; 0 for models that render none.
    features: f64,
}

impl Difference {
    fn between(before: &Picture, after: &Picture) -> Result<Self> {
        let [features_before, features_after] = [&before.frame, &after.frame].map(|frame| frame.features.as_ref());
        Ok(Self {
            masks: absolute(&before.frame.masks, &after.frame.masks)?,
            depth: absolute(&before.frame.depth, &after.frame.depth)?,
            colour: absolute(&before.rgb, &after.rgb)?,
            region_colour: region_colour(before, after)?,
            features: match features_before.zip(features_after) {
                Some((before, after)) => absolute(before, after)?,
                None => 0.0,
            },
        })
    }

    fn plus(self, other: Self) -> Self {
        Self {
            masks: self.masks + other.masks,
            depth: self.depth + other.depth,
            colour: self.colour + other.colour,
            region_colour: self.region_colour + other.region_colour,
            features: self.features + other.features,
        }
    }
}

fn absolute(a: &Tensor, b: &Tensor) -> Result<f64> {
    Ok((a - b)?.detach().abs()?.to_dtype(DType::F64)?.mean_all()?.to_scalar()?)
}

/// Mean over regions that both pictures show of the absolute difference of their mean colours.
fn region_colour(before: &Picture, after: &Picture) -> Result<f64> {
    let mean = |picture: &Picture| -> Result<(Vec<f64>, Vec<Vec<f64>>)> {
        let flat = |tensor: &Tensor| -> Result<Tensor> {
            Ok(tensor.detach().to_device(&Device::Cpu)?.to_dtype(DType::F64)?.squeeze(0)?.flatten_from(1)?)
        };
        let masks = flat(&picture.masks)?;
        let sums = masks.matmul(&flat(&picture.rgb)?.t()?)?;
        Ok((masks.sum(1)?.to_vec1()?, sums.to_vec2()?))
    };
    let ((area_before, sums_before), (area_after, sums_after)) = (mean(before)?, mean(after)?);
    let (mut total, mut count) = (0.0, 0);
    for region in 0..REGION_COUNT {
        if area_before[region].min(area_after[region]) >= LEAST_PIXELS {
            let colours = sums_before[region].iter().zip(&sums_after[region]);
            let off = colours.map(|(a, b)| (a / area_before[region] - b / area_after[region]).abs());
            (total, count) = (total + off.sum::<f64>() / 3.0, count + 1);
        }
    }
    Ok(total / f64::from(count.max(1)))
}

/// What swapping codes of one portrait changed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Swaps {
    shape: Difference,
    texture: Difference,
    both: Difference,
}

/// Gives `subject` all shape codes, all texture codes and both of `donor` `[1, 9, 2, D]`, in the subject's own view.
pub fn swap_all(subject: &Subject<'_>, donor: &Tensor) -> Result<Swaps> {
    let before = subject.picture(&subject.camera)?;
    let swap = |aspect: Aspect| {
        let codes = codes::blend(&subject.codes, donor, RegionSet::ALL, aspect, 1.0)?;
        Difference::between(&before, &Subject { codes, ..subject.clone() }.picture(&subject.camera)?)
    };
    Ok(Swaps { shape: swap(Aspect::Shape)?, texture: swap(Aspect::Texture)?, both: swap(Aspect::Both)? })
}

/// What a swap of one aspect changes, as shares of what a swap of both does; none where that changes nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Carried {
    /// Rendered masks.
    pub masks: Option<f64>,
    /// Depth.
    pub depth: Option<f64>,
    /// Colours pixel by pixel: moved edges count too.
    pub colour: Option<f64>,
    /// Mean colours of the regions, wherever they lie: texture apart from where it is.
    pub region_colour: Option<f64>,
    /// Rendered features pixel by pixel.
    pub features: Option<f64>,
}

/// How well shape and texture are separated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Separation {
    /// Of a shape swap: masks and depth should be 1, `region_colour` 0; the last is how much of a texture change the
    /// shape codes carry.
    pub shape: Carried,
    /// Of a texture swap: masks and depth should be 0, `region_colour` 1.
    pub texture: Carried,
}

/// Gathers the swaps of several portraits: ratios of means, so that portraits that happen to be alike do not count much.
pub fn summary(portraits: &[Swaps]) -> Separation {
    let sum = |part: fn(&Swaps) -> Difference| portraits.iter().map(part).fold(Difference::default(), Difference::plus);
    let both = sum(|swaps| swaps.both);
    let carried = |of: Difference| {
        let share = |part: f64, whole: f64| (whole > 0.0).then(|| part / whole);
        Carried {
            masks: share(of.masks, both.masks),
            depth: share(of.depth, both.depth),
            colour: share(of.colour, both.colour),
            region_colour: share(of.region_colour, both.region_colour),
            features: share(of.features, both.features),
        }
    };
    Separation { shape: carried(sum(|swaps| swaps.shape)), texture: carried(sum(|swaps| swaps.texture)) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        camera::Camera,
        config::{FieldConfig, GeneratorConfig, SdfHead},
        model::generator::Generator,
        parameters::Parameters,
    };

    fn separation(sdf_head: SdfHead) -> Separation {
        let field = FieldConfig { style_dim: 8, width: 8, sdf_head, ..FieldConfig::ours() };
        let config =
            GeneratorConfig { field, upsampler: None, camera_deviation_rad: [0.3, 0.15], samples: 6, population: 0 };
        let generator = Generator::new(&config, &Parameters::fresh(2, DType::F32, &Device::Cpu)).unwrap();
        let swaps: Vec<Swaps> = (0..2)
            .map(|seed| {
                let subject = Subject::random(&generator, seed, 1.0, Camera::at(0.1, 0.0)).unwrap();
                swap_all(&subject, &generator.codes_from_seed(seed + 10, 1.0).unwrap()).unwrap()
            })
            .collect();
        summary(&swaps)
    }

    #[test]
    fn a_texture_swap_moves_nothing_where_the_shape_has_the_distance_and_something_where_it_has_not() {
        let ours = separation(SdfHead::Shape);
        assert_eq!((ours.texture.masks, ours.texture.depth), (Some(0.0), Some(0.0)), "{ours:?}");
        assert_eq!((ours.shape.masks, ours.shape.depth), (Some(1.0), Some(1.0)), "{ours:?}");
        assert!(ours.texture.colour.is_some_and(|share| share > 0.0), "{ours:?}");
        assert_eq!(ours.shape.features, None, "no upsampler, no features");
        let theirs = separation(SdfHead::Texture);
        assert!(theirs.texture.depth.is_some_and(|share| share > 0.0), "{theirs:?}");
        assert_eq!(theirs.texture.masks.map(|share| share > 0.0), Some(true), "a moved surface has other masks");
    }

    #[test]
    fn mean_colours_do_not_see_where_a_region_lies() {
        let side = 8;
        let picture = |columns: usize, colour: f32| {
            let inside = |pixel: usize| pixel % side < columns;
            let mut masks = vec![0f32; REGION_COUNT * side * side];
            (0..side * side).for_each(|pixel| masks[usize::from(inside(pixel)) * side * side + pixel] = 1.0);
            let plane: Vec<f32> = (0..side * side).map(|pixel| if inside(pixel) { colour } else { 0.0 }).collect();
            let tensor = |values: Vec<f32>, channels: usize| {
                Tensor::from_vec(values, (1, channels, side, side), &Device::Cpu).unwrap()
            };
            let (masks, rgb) = (tensor(masks, REGION_COUNT), tensor([plane.clone(), plane.clone(), plane].concat(), 3));
            let depth = rgb.narrow(1, 0, 1).unwrap();
            let frame = crate::render::Frame {
                colour: rgb.clone(),
                features: None,
                masks: masks.clone(),
                depth: depth.clone(),
                normal: None,
                point: rgb.clone(),
                opacity: depth,
            };
            Picture { rgb, masks, frame }
        };
        let found = Difference::between(&picture(4, 0.5), &picture(6, 0.5)).unwrap();
        assert!(found.region_colour < 1e-12 && found.masks > 0.0 && found.colour > 0.0, "{found:?}");
        let found = Difference::between(&picture(4, 0.5), &picture(4, 0.25)).unwrap();
        // Two regions, one of them changed by a quarter.
        assert!((found.region_colour - 0.125).abs() < 1e-6 && found.masks == 0.0, "{found:?}");
    }
}
