//! What is measured of a variant.

use anyhow::Result;
use cnerf_core::{
    codes::{self, Aspect},
    data::dataset::Dataset,
    eval::{
        consistency::Consistency,
        features::PictureFeatures,
        locality::EditChange,
        realism::{RealismOptions, camera_like, realism, reconstruction},
        separation::{self, Separation},
        subject::Subject,
    },
    region::{Region, RegionSet},
    train::trainer::Start,
};
use serde::Serialize;

use crate::Options;

/// Truncation of the portraits that are edited and turned, as in `cnerf eval`.
const TRUNCATION: f64 = 0.7;

/// A hair swap, mean over portraits.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct HairSwap {
    /// Mean colour change outside the hair over that inside.
    pub outside_share: Option<f64>,
    /// Depth change of the head outside the hair, world units.
    pub outside_depth: Option<f64>,
}

/// The numbers of one variant.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Measured {
    /// Training portraits from their own codes, dB.
    pub reconstruction_psnr: Option<f64>,
    /// IoU of the same portraits' regions with their labels.
    pub mask_miou: Option<f64>,
    /// Views at ±0.3 rad, each carried to the other, dB.
    pub reprojection_psnr: Option<f64>,
    /// Hair shape swapped.
    pub hair_shape: HairSwap,
    /// Hair texture swapped.
    pub hair_texture: HairSwap,
    /// All shape codes, or all texture codes, swapped.
    pub separation: Separation,
    /// Fréchet distance of random portraits to the training data.
    pub fid: Option<f64>,
    /// The same of the training data blurred.
    pub blur_fid: Option<f64>,
}

/// Measures a trained variant; `whole_head` swaps all regions' codes where only the hair's are meant.
pub fn measure(
    trained: &Start,
    dataset: &Dataset,
    features: Option<&dyn PictureFeatures>,
    whole_head: bool,
    options: &Options,
) -> Result<Measured> {
    let generator = &trained.generator;
    let counted = |count: usize| RealismOptions { count, truncation: 1.0, seed: options.seed };
    let mut found = Measured::default();
    if let Some(codes) = &trained.portrait_codes {
        let shown = reconstruction(generator, codes, dataset, None, &counted(options.pictures))?;
        (found.reconstruction_psnr, found.mask_miou) = (Some(shown.psnr), shown.mask_miou);
    }
    if features.is_some() {
        let compared = realism(generator, dataset, features, &counted(options.pictures), &mut |_| ())?;
        (found.fid, found.blur_fid) = (compared.fid, compared.blur_fid);
    }

    let edited = if whole_head { RegionSet::ALL } else { Region::Hair.into() };
    let (mut views, mut swaps) = (Vec::new(), Vec::new());
    let mut hair = [Vec::new(), Vec::new()];
    for index in 0..options.portraits {
        let seed = options.seed + index as u64;
        let camera = camera_like(dataset, options.seed, index)?;
        let subject = Subject::random(generator, seed, TRUNCATION, camera)?;
        let donor = Subject::random(generator, seed + options.portraits as u64, TRUNCATION, camera)?.codes;
        let before = subject.picture(&camera)?;
        for (aspect, changes) in [Aspect::Shape, Aspect::Texture].into_iter().zip(&mut hair) {
            let codes = codes::blend(&subject.codes, &donor, edited, aspect, 1.0)?;
            let after = Subject { codes, ..subject.clone() }.picture(&camera)?;
            changes.push(EditChange::between(&before, &after, Region::Hair.into())?);
        }
        swaps.push(separation::swap_all(&subject, &donor)?);
        views.push(Consistency::of(&subject)?);
    }
    found.reprojection_psnr = Consistency::mean(&views).reprojection_psnr;
    found.separation = separation::summary(&swaps);
    [found.hair_shape, found.hair_texture] = hair.map(|changes| mean(&changes));
    Ok(found)
}

fn mean(changes: &[EditChange]) -> HairSwap {
    let mean = |value: fn(&EditChange) -> Option<f64>| {
        let values: Vec<f64> = changes.iter().filter_map(value).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let share = |(inside, outside): (f64, f64)| (inside > 0.0).then(|| outside / inside);
    HairSwap {
        outside_share: mean(|change| change.inside).zip(mean(|change| change.outside)).and_then(share),
        outside_depth: mean(|change| change.outside_depth),
    }
}
