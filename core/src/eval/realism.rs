//! How like a data set random portraits are: distances of feature distributions with their floor and a blur reference
//! beside them, sharpness, energy near the Nyquist frequency, and where regions lie.
//!
//! Pictures are made and read one at a time; what is kept of each is its feature vector and a few numbers.

use candle_core::{Device, Tensor};
use serde::Serialize;

use super::{
    distribution::{FeatureSet, extrapolated_frechet, frechet_distance, kernel_distance, precision_recall},
    features::PictureFeatures,
    quality::{self, Agreement},
    spectrum::nyquist_share,
    subject::{Subject, photo_camera, picture_of},
};
use crate::{
    camera::Camera,
    data::{
        dataset::{Dataset, Item},
        labels::LabelMap,
        loader::Draw,
        picture::{self, RgbImage},
    },
    error::{Error, Result},
    model::generator::Generator,
    region::{REGION_COUNT, Region},
    rng::Stream,
    train::{people::People, portrait_codes::PortraitCodes},
};

/// Width and height that the blur reference is reduced to, pixels.
pub const BLUR_SIDE: u32 = 16;
/// The first element of every stream drawn here.
const STREAM: u64 = 0x7265_616c;
/// The fewest pictures of a set: half of them make a floor.
const LEAST: usize = 8;

/// How much is compared, and how portraits are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RealismOptions {
    /// Random portraits; of the data set, as many or all.
    pub count: usize,
    /// Truncation ψ of the portraits.
    pub truncation: f64,
    /// Portrait i is the one of `cnerf generate --seeds SEED + i`; the choice of photos is drawn from it as well.
    pub seed: u64,
}

/// A number of a model's portraits and the same of photos.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Compared {
    /// Mean of the portraits.
    pub generated: f64,
    /// Mean of the photos.
    pub real: f64,
    /// Generated over real.
    pub share: f64,
}

impl Compared {
    fn of(generated: &[f64], real: &[f64]) -> Self {
        let (generated, real) = (mean(generated), mean(real));
        Self { generated, real, share: generated / real.max(f64::MIN_POSITIVE) }
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Realism {
    /// Fréchet distance of random portraits to the photos; none without features.
    pub fid: Option<f64>,
    /// The same for infinitely many pictures; none if there are fewer pictures than features.
    pub fid_infinity: Option<f64>,
    /// Kernel distance, whose mean does not depend on the number of pictures.
    pub kid: Option<f64>,
    /// Fréchet distance of one half of the photos to the other half. It holds the bias of half as many pictures.
    pub floor_fid: Option<f64>,
    /// Kernel distance of the halves: 0 but for chance.
    pub floor_kid: Option<f64>,
    /// Fréchet distance of the photos, reduced to 16² and back, to themselves.
    pub blur_fid: Option<f64>,
    /// Kernel distance of the same.
    pub blur_kid: Option<f64>,
    /// `fid` over `blur_fid`.
    pub fid_of_blur: Option<f64>,
    /// `kid` over `blur_kid`.
    pub kid_of_blur: Option<f64>,
    /// Share of random portraits that lie among the photos.
    pub precision: Option<f64>,
    /// Share of photos that lie among the random portraits.
    pub recall: Option<f64>,
    /// What the distances are computed in; not comparable with Inception-FID.
    pub features: Option<String>,
    /// Random portraits.
    pub count: usize,
    /// Photos.
    pub real_count: usize,
    /// Width and height that both are compared at, pixels.
    pub resolution: usize,
    /// Standard deviation of the Laplacian, [0, 1] units.
    pub sharpness: Compared,
    /// Share of the luma's variance near the Nyquist frequency.
    pub nyquist: Compared,
    /// Overlap of the regions' mean masks, photos' against portraits': Σ min / Σ max, mean over regions. None if the
    /// data has no masks.
    pub region_map_overlap: Option<f64>,
    /// Each region's share of all pixels; no real one if the data has no masks.
    pub regions: Vec<RegionShare>,
    /// Sharpness and Nyquist share of every picture, for histograms.
    #[serde(skip)]
    pub values: Values,
}

/// How much of the picture a region covers.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RegionShare {
    /// The region.
    pub region: Region,
    /// Mean share of random portraits.
    pub generated: f64,
    /// Mean share of the photos.
    pub real: Option<f64>,
}

/// One number of every picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Values {
    /// Sharpness of random portraits and of photos.
    pub sharpness: [Vec<f64>; 2],
    /// Nyquist share of random portraits and of photos.
    pub nyquist: [Vec<f64>; 2],
}

/// What is kept of one set of pictures.
struct Gathered {
    features: FeatureSet,
    sharpness: Vec<f64>,
    nyquist: Vec<f64>,
    /// Sum of masks, `[9, r, r]` in row order, and how many were added.
    masks: Vec<f64>,
    masked: usize,
}

impl Gathered {
    fn new(features: Option<&dyn PictureFeatures>, resolution: usize) -> Self {
        Self {
            features: FeatureSet::new(features.map_or(0, PictureFeatures::length)),
            sharpness: Vec::new(),
            nyquist: Vec::new(),
            masks: vec![0.0; REGION_COUNT * resolution * resolution],
            masked: 0,
        }
    }

    fn add(&mut self, rgb: &Tensor, features: Option<&dyn PictureFeatures>) -> Result<()> {
        if let Some(features) = features {
            features.of(rgb)?.iter().try_for_each(|vector| self.features.push(vector))?;
        }
        self.sharpness.extend(quality::laplacian_deviation(rgb)?);
        self.nyquist.extend(nyquist_share(rgb)?);
        Ok(())
    }

    fn add_masks(&mut self, masks: &[f32]) {
        self.masked += 1;
        for (sum, value) in self.masks.iter_mut().zip(masks) {
            *sum += f64::from(*value);
        }
    }

    /// The mean mask of a region, if masks were added.
    fn mean_mask(&self, region: Region) -> Option<Vec<f64>> {
        let pixels = self.masks.len() / REGION_COUNT;
        let sums = self.masks.iter().skip(region.index() * pixels).take(pixels);
        (self.masked > 0).then(|| sums.map(|sum| sum / self.masked as f64).collect())
    }
}

/// Compares random portraits of `generator` with photos of `dataset`, both at the model's output resolution. Without
/// `features` no distribution is compared. `progress` is called after every picture with the number done, of
/// [`steps`].
///
/// # Errors
/// [`Error::Config`] for too few pictures; what is wrong with a file of the data set.
pub fn realism(
    generator: &Generator,
    dataset: &Dataset,
    features: Option<&dyn PictureFeatures>,
    options: &RealismOptions,
    progress: &mut dyn FnMut(usize),
) -> Result<Realism> {
    let chosen = chosen(dataset, options);
    for (option, count) in [("--count", options.count), ("--data", chosen.len())] {
        if count < LEAST {
            return Err(Error::config(option, format!("{count} pictures are too few; give at least {LEAST}")));
        }
    }
    let (resolution, render_resolution) = (generator.output_resolution(), generator.render_resolution());
    let device = generator.device();
    let mut real = Gathered::new(features, render_resolution);
    let mut blurred = FeatureSet::new(real.features.length());
    for (done, index) in chosen.iter().enumerate() {
        let Item { image, mask, .. } = dataset.item(*index)?;
        real.add(&at(&image, resolution, &device)?, features)?;
        if let Some(features) = features {
            let small = picture::resize_area(&image, BLUR_SIDE, BLUR_SIDE)?;
            features.of(&at(&small, resolution, &device)?)?.iter().try_for_each(|vector| blurred.push(vector))?;
        }
        if let Some(mask) = mask {
            real.add_masks(&mask.one_hot(render_resolution as u32, render_resolution as u32));
        }
        progress(done + 1);
    }
    let mut generated = Gathered::new(features, render_resolution);
    for portrait in 0..options.count {
        let camera = match chosen.get(portrait % chosen.len()).map(|index| dataset.camera(*index)).transpose()? {
            Some(Some(camera)) => camera,
            _ => photo_camera(options.seed, portrait as u64),
        };
        let seed = options.seed.wrapping_add(portrait as u64);
        let shown = Subject::random(generator, seed, options.truncation, camera)?.picture(&camera)?;
        // As a file would hold it: photos are eight bits deep as well.
        generated.add(&picture::to_tensor(&picture::from_tensor(&shown.rgb)?, &device)?, features)?;
        generated.add_masks(&shown.frame.masks.detach().flatten_all()?.to_device(&Device::Cpu)?.to_vec1::<f32>()?);
        progress(chosen.len() + portrait + 1);
    }
    let mut found = compared(real, generated);
    if let Some(features) = features {
        distances(&mut found, &blurred, options.seed)?;
        found.report.features = Some(features.name().to_owned());
    }
    Ok(Realism { count: options.count, real_count: chosen.len(), resolution, ..found.report })
}

/// Pictures that [`realism`] makes or reads.
pub fn steps(dataset: &Dataset, options: &RealismOptions) -> usize {
    options.count + dataset.len().min(options.count)
}

fn chosen(dataset: &Dataset, options: &RealismOptions) -> Vec<usize> {
    let order = Stream::new(options.seed, &[STREAM]).permutation(dataset.len());
    order.into_iter().take(options.count).collect()
}

fn at(image: &RgbImage, resolution: usize, device: &Device) -> Result<Tensor> {
    let side = resolution as u32;
    picture::to_tensor(&[picture::resize(image, side, side)?], device)
}

struct Found {
    report: Realism,
    real: FeatureSet,
    generated: FeatureSet,
}

fn compared(real: Gathered, generated: Gathered) -> Found {
    let maps = Region::ALL.map(|region| (region, generated.mean_mask(region), real.mean_mask(region)));
    let overlap = |a: &[f64], b: &[f64]| {
        let (least, most) = a.iter().zip(b).fold((0.0, 0.0), |(l, m), (a, b)| (l + a.min(*b), m + a.max(*b)));
        (most > 0.0).then(|| least / most)
    };
    let overlaps: Vec<f64> =
        maps.iter().filter_map(|(_, generated, real)| overlap(generated.as_deref()?, real.as_deref()?)).collect();
    let regions = maps.iter().map(|(region, generated, real)| RegionShare {
        region: *region,
        generated: generated.as_deref().map(mean).unwrap_or_default(),
        real: real.as_deref().map(mean),
    });
    let report = Realism {
        sharpness: Compared::of(&generated.sharpness, &real.sharpness),
        nyquist: Compared::of(&generated.nyquist, &real.nyquist),
        region_map_overlap: (!overlaps.is_empty()).then(|| mean(&overlaps)),
        regions: regions.collect(),
        values: Values { sharpness: [generated.sharpness, real.sharpness], nyquist: [generated.nyquist, real.nyquist] },
        ..Realism::default()
    };
    Found { report, real: real.features, generated: generated.features }
}

fn distances(found: &mut Found, blurred: &FeatureSet, seed: u64) -> Result<()> {
    let (real, generated, report) = (&found.real, &found.generated, &mut found.report);
    let (first, second) = real.halves();
    let (fid, kid) = (frechet_distance(real, generated)?, kernel_distance(real, generated)?);
    let (blur_fid, blur_kid) = (frechet_distance(real, blurred)?, kernel_distance(real, blurred)?);
    let lies = precision_recall(real, generated)?;
    (report.fid, report.kid) = (Some(fid), Some(kid));
    report.fid_infinity = extrapolated_frechet(real, generated, seed)?;
    report.floor_fid = Some(frechet_distance(&first, &second)?);
    report.floor_kid = Some(kernel_distance(&first, &second)?);
    (report.blur_fid, report.blur_kid) = (Some(blur_fid), Some(blur_kid));
    report.fid_of_blur = (blur_fid > 0.0).then(|| fid / blur_fid);
    report.kid_of_blur = (blur_kid > 0.0).then(|| kid / blur_kid);
    (report.precision, report.recall) = (Some(lies.precision), Some(lies.recall));
    Ok(())
}

/// How well portraits of known codes show their photos.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Reconstruction {
    /// Portraits compared.
    pub count: usize,
    /// Mean PSNR of the render under the picture, dB.
    pub render_psnr: f64,
    /// Mean PSNR of the finished picture, dB.
    pub psnr: f64,
    /// Mean IoU of the rendered regions, if the photos have masks.
    pub mask_miou: Option<f64>,
    /// Mean perceptual distance, if weights are there.
    pub lpips: Option<f64>,
    /// Sharpness of the finished pictures and of the very photos they show.
    pub sharpness: Compared,
}

/// Whether there is a code for everyone on the photos of `dataset`, or for them and their mirror images.
pub fn are_codes_of(portraits: &PortraitCodes, dataset: &Dataset) -> bool {
    let people = People::of(dataset, false).count();
    [people, 2 * people].contains(&portraits.count())
}

/// Shows training portraits from their own codes (photos in the data set's order, then mirrored copies), and compares
/// them with the photos.
///
/// # Errors
/// [`Error::Shape`] if the codes are not those of `dataset`.
pub fn reconstruction(
    generator: &Generator,
    portraits: &PortraitCodes,
    dataset: &Dataset,
    features: Option<&dyn PictureFeatures>,
    options: &RealismOptions,
) -> Result<Reconstruction> {
    if !are_codes_of(portraits, dataset) {
        let expected = format!("codes of {} portraits and their mirrored copies", dataset.len());
        return Err(Error::shape("training codes", expected, portraits.noise.dims()));
    }
    let people = People::of(dataset, false);
    let (device, resolution) = (generator.device(), generator.output_resolution());
    let (mut found, mut agreement, mut distance) = (Reconstruction::default(), Agreement::default(), 0.0);
    let (mut sharpness, mut masked) = ([Vec::new(), Vec::new()], false);
    let perceptual = features.and_then(PictureFeatures::perceptual);
    for index in chosen(dataset, options) {
        let Item { image, mask, camera } = dataset.item(index)?;
        let row = people.row(Draw { index, mirrored: false }) as u32;
        let codes = portraits.codes(generator, &[row])?.detach();
        let shown = picture_of(generator, &codes, None, &camera.unwrap_or_default())?;
        let psnr = |rgb: &Tensor, photo: &Tensor| -> Result<f64> {
            Ok(quality::psnr(rgb, photo)?.first().copied().unwrap_or_default())
        };
        let photo = at(&image, resolution, &device)?;
        for (values, rgb) in sharpness.iter_mut().zip([&shown.rgb, &photo]) {
            values.extend(quality::laplacian_deviation(rgb)?);
        }
        found.count += 1;
        found.psnr += psnr(&shown.rgb, &photo)?;
        found.render_psnr += psnr(&shown.frame.colour, &at(&image, generator.render_resolution(), &device)?)?;
        if let Some(perceptual) = perceptual {
            let lpips = perceptual.distance(&shown.rgb, &photo)?;
            distance += lpips.to_vec1::<f32>()?.first().copied().map_or(0.0, f64::from);
        }
        if let Some(mask) = mask {
            masked = true;
            let found = LabelMap::from_masks(&shown.masks.squeeze(0)?)?;
            agreement.add(&mask.resized(found.width(), found.height())?, &found)?;
        }
    }
    let [shown, photos] = &sharpness;
    let count = found.count.max(1) as f64;
    Ok(Reconstruction {
        sharpness: Compared::of(shown, photos),
        psnr: found.psnr / count,
        render_psnr: found.render_psnr / count,
        mask_miou: if masked { agreement.mean_iou() } else { None },
        lpips: perceptual.map(|_| distance / count),
        ..found
    })
}

/// The camera of one of `dataset`'s photos, or of photos in general where it names none: what portrait `index` of an
/// evaluation is seen from.
///
/// # Errors
/// A camera in the data set whose angles are out of range.
pub fn camera_like(dataset: &Dataset, seed: u64, index: usize) -> Result<Camera> {
    let order = Stream::new(seed, &[STREAM]).permutation(dataset.len());
    let item = order.get(index % order.len().max(1)).copied();
    let camera = item.map(|item| dataset.camera(item)).transpose()?.flatten();
    Ok(camera.unwrap_or_else(|| photo_camera(seed, index as u64)))
}
