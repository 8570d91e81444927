//! Whether an edit stays where it was made: colours change inside the edited regions and nowhere else, a texture edit
//! moves no surface, a shape edit moves only its own.

use candle_core::{DType, Device, Tensor};
use serde::Serialize;

use super::{quality, subject::Subject};
use crate::{
    codes::{self, Aspect},
    data::labels::LabelMap,
    error::Result,
    model::generator::Picture,
    region::{Region, RegionSet},
};

/// A pixel with more opacity shows the head.
const FOREGROUND: f32 = 0.5;

/// What an edit changed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EditChange {
    /// Mean absolute colour change in [0, 1] where the edited regions were or are, grown by a pixel (a picture's edges
    /// are a pixel wide); none if they are nowhere.
    pub inside: Option<f64>,
    /// The same elsewhere.
    pub outside: Option<f64>,
    /// Mean absolute depth change of the whole render, world units.
    pub depth: f64,
    /// Mean absolute depth change of the head outside the edited regions, world units.
    pub outside_depth: Option<f64>,
}

impl EditChange {
    /// Compares two pictures of one view. Regions are those of the largest mask at each pixel.
    pub fn between(before: &Picture, after: &Picture, regions: RegionSet) -> Result<Self> {
        let inside = edited(&before.masks, &after.masks, regions)?;
        let colours = [before.rgb.clamp(-1.0, 1.0)?, after.rgb.clamp(-1.0, 1.0)?];
        let [before_rgb, after_rgb] = &colours;
        let change = quality::change(before_rgb, after_rgb, &inside)?.into_iter().next();
        let moved = (&before.frame.depth - &after.frame.depth)?.abs()?.to_dtype(DType::F64)?.flatten_all()?;
        let moved = moved.to_device(&Device::Cpu)?.to_vec1::<f64>()?;
        let inside = values(&edited(&before.frame.masks, &after.frame.masks, regions)?)?;
        let (was, is) = (values(&before.frame.opacity)?, values(&after.frame.opacity)?);
        let (mut sum, mut count) = (0.0, 0usize);
        for (((moved, inside), was), is) in moved.iter().zip(inside).zip(was).zip(is) {
            if inside == 0.0 && was > FOREGROUND && is > FOREGROUND {
                (sum, count) = (sum + moved, count + 1);
            }
        }
        Ok(Self {
            inside: change.and_then(|change| change.inside),
            outside: change.and_then(|change| change.outside),
            depth: moved.iter().sum::<f64>() / moved.len().max(1) as f64,
            outside_depth: (count > 0).then(|| sum / count as f64),
        })
    }
}

fn values(tensor: &Tensor) -> Result<Vec<f32>> {
    Ok(tensor.detach().to_device(&Device::Cpu)?.to_dtype(DType::F32)?.flatten_all()?.to_vec1()?)
}

/// 1 where `regions` have the largest mask before or after, or beside such a pixel: `[1, 1, H, W]` of `[1, 9, H, W]`.
fn edited(before: &Tensor, after: &Tensor, regions: RegionSet) -> Result<Tensor> {
    let (old, new) = (LabelMap::from_masks(&before.squeeze(0)?)?, LabelMap::from_masks(&after.squeeze(0)?)?);
    let (width, height) = (old.width() as usize, old.height() as usize);
    let shown = |label: &u8| Region::from_label(*label).is_some_and(|region| regions.contains(region));
    let inside: Vec<bool> = old.labels().iter().zip(new.labels()).map(|(a, b)| shown(a) || shown(b)).collect();
    let grown = (0..width * height).map(|index| {
        let (x, y) = (index % width, index / width);
        let mut near = (y.saturating_sub(1)..(y + 2).min(height))
            .flat_map(|row| (x.saturating_sub(1)..(x + 2).min(width)).map(move |column| row * width + column));
        f32::from(u8::from(near.any(|index| inside.get(index).copied().unwrap_or(false))))
    });
    Ok(Tensor::from_vec(grown.collect::<Vec<f32>>(), (1, 1, height, width), before.device())?)
}

/// The changes of one kind of edit over several portraits.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Locality {
    /// The region whose codes were swapped.
    pub region: Region,
    /// Which of its codes.
    pub aspect: Aspect,
    /// Edits measured.
    pub edits: usize,
    /// Mean of [`EditChange::inside`]; none if the region was nowhere to be seen.
    pub inside_change: Option<f64>,
    /// Mean of [`EditChange::outside`].
    pub outside_change: Option<f64>,
    /// Outside over inside: 0 is an edit that stays where it was made.
    pub outside_share: Option<f64>,
    /// Mean of [`EditChange::depth`], world units.
    pub depth_change: f64,
    /// The largest of the depth changes: exactly 0 for a texture edit of a model that promises it.
    pub largest_depth_change: f64,
    /// Mean of [`EditChange::outside_depth`], world units.
    pub outside_depth_change: Option<f64>,
}

/// Kinds of edits in the order of reports: every region's shape, then its texture.
pub fn kinds() -> impl Iterator<Item = (Region, Aspect)> {
    Region::ALL.into_iter().flat_map(|region| [(region, Aspect::Shape), (region, Aspect::Texture)])
}

/// Gives `subject` each kind of code row of `donor` `[1, 9, 2, D]` by turn, and measures each edit in the subject's
/// own view, in the order of [`kinds`].
pub fn swap_each(subject: &Subject<'_>, donor: &Tensor) -> Result<Vec<EditChange>> {
    let before = subject.picture(&subject.camera)?;
    let swap = |(region, aspect): (Region, Aspect)| {
        let regions = RegionSet::from(region);
        let codes = codes::blend(&subject.codes, donor, regions, aspect, 1.0)?;
        let after = Subject { codes, ..subject.clone() }.picture(&subject.camera)?;
        EditChange::between(&before, &after, regions)
    };
    kinds().map(swap).collect()
}

/// Gathers the changes of several portraits, each from [`swap_each`].
pub fn summary(portraits: &[Vec<EditChange>]) -> Vec<Locality> {
    let of_kind = |(index, (region, aspect)): (usize, (Region, Aspect))| {
        let changes: Vec<EditChange> = portraits.iter().filter_map(|changes| changes.get(index).copied()).collect();
        let mean = |value: fn(&EditChange) -> Option<f64>| {
            let values: Vec<f64> = changes.iter().filter_map(value).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        let (inside_change, outside_change) = (mean(|change| change.inside), mean(|change| change.outside));
        let share = |(inside, outside): (f64, f64)| (inside > 0.0).then(|| outside / inside);
        Locality {
            region,
            aspect,
            edits: changes.len(),
            inside_change,
            outside_change,
            outside_share: inside_change.zip(outside_change).and_then(share),
            depth_change: mean(|change| Some(change.depth)).unwrap_or_default(),
            largest_depth_change: changes.iter().map(|change| change.depth).fold(0.0, f64::max),
            outside_depth_change: mean(|change| change.outside_depth),
        }
    };
    kinds().enumerate().map(of_kind).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{region::REGION_COUNT, render::Frame};

    const SIDE: usize = 8;

    /// Hair on the left half, background on the right of the lowest row, face elsewhere.
    fn picture(colour: impl Fn(usize, usize) -> f32, depth: impl Fn(usize, usize) -> f32) -> Picture {
        let places = || (0..SIDE * SIDE).map(|index| (index % SIDE, index / SIDE));
        let background = |x: usize, y: usize| y == SIDE - 1 && x >= SIDE / 2;
        let tensor = |values: Vec<f32>, channels: usize| {
            Tensor::from_vec(values, (1, channels, SIDE, SIDE), &Device::Cpu).unwrap()
        };
        let mut masks = vec![0f32; REGION_COUNT * SIDE * SIDE];
        for (index, (x, y)) in places().enumerate() {
            let region = match (background(x, y), x < SIDE / 2) {
                (true, _) => Region::Background,
                (false, true) => Region::Hair,
                (false, false) => Region::Face,
            };
            masks[region.index() * SIDE * SIDE + index] = 1.0;
        }
        let (masks, plane) = (tensor(masks, 9), places().map(|(x, y)| colour(x, y)).collect::<Vec<_>>());
        let rgb = tensor([plane.clone(), plane.clone(), plane].concat(), 3);
        let frame = Frame {
            colour: rgb.clone(),
            features: None,
            masks: masks.clone(),
            depth: tensor(places().map(|(x, y)| depth(x, y)).collect(), 1),
            normal: None,
            point: rgb.clone(),
            opacity: tensor(places().map(|(x, y)| f32::from(u8::from(!background(x, y)))).collect(), 1),
        };
        Picture { rgb, masks, frame }
    }

    #[test]
    fn changes_are_told_apart_by_region_and_depth_by_foreground() {
        let before = picture(|_, _| 0.0, |_, _| 1.0);
        // Hair 0.5 brighter (of 2), the last column 0.25; depth 0.01 in the last column, 0.1 more in its background.
        let after = picture(
            |x, _| {
                if x < 4 {
                    0.5
                } else if x == 7 {
                    0.25
                } else {
                    0.0
                }
            },
            |x, y| if x == 7 { if y == 7 { 1.11 } else { 1.01 } } else { 1.0 },
        );
        let change = EditChange::between(&before, &after, Region::Hair.into()).unwrap();
        // Inside: four columns of hair and one of margin. Outside: three columns, one of them changed by 0.125.
        assert!((change.inside.unwrap() - 0.25 * 4.0 / 5.0).abs() < 1e-6, "{change:?}");
        assert!((change.outside.unwrap() - 0.125 / 3.0).abs() < 1e-6, "{change:?}");
        assert!((change.depth - (7.0 * 0.01 + 0.11) / 64.0).abs() < 1e-6, "{change:?}");
        assert!((change.outside_depth.unwrap() - 0.01 * 7.0 / 21.0).abs() < 1e-6, "{change:?}");
        let nowhere = EditChange::between(&before, &after, Region::Nose.into()).unwrap();
        assert_eq!(nowhere.inside, None);

        let kinds = kinds().count();
        let found = summary(&[vec![change; kinds], vec![EditChange::default(); kinds]]);
        assert_eq!((found.len(), found[15].region, found[15].aspect), (18, Region::Hair, Aspect::Texture));
        assert_eq!(found[15].edits, 2);
        // A portrait without the region does not dilute the mean.
        assert_eq!(found[15].inside_change, change.inside);
        assert_eq!(found[15].largest_depth_change, change.depth);
        assert!((found[15].outside_share.unwrap() - 0.125 / 3.0 / 0.2).abs() < 1e-6);
    }
}
