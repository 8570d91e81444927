//! Label maps: which region each pixel shows.

use std::path::Path;

use candle_core::{Device, Tensor};
use image::GrayImage;

use super::picture::{self, RgbImage, area_weights};
use crate::{
    error::{Error, Result},
    region::{REGION_COUNT, Region},
};

/// The 19 classes of CelebAMask-HQ in the order of its label values.
pub const CELEBAMASK_HQ_CLASSES: [&str; 19] = [
    "background",
    "skin",
    "nose",
    "glasses",
    "l_eye",
    "r_eye",
    "l_brow",
    "r_brow",
    "l_ear",
    "r_ear",
    "mouth",
    "u_lip",
    "l_lip",
    "hair",
    "hat",
    "earring",
    "necklace",
    "neck",
    "cloth",
];

/// What the label values of a set of maps mean.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LabelScheme {
    regions: Vec<Region>,
}

impl LabelScheme {
    /// The suite's own: the value is the region's index.
    pub fn cnerf() -> Self {
        Self { regions: Region::ALL.to_vec() }
    }

    /// CelebAMask-HQ's 19 classes in its own order, see [`CELEBAMASK_HQ_CLASSES`].
    pub fn celebamask_hq() -> Self {
        Self { regions: CELEBAMASK_HQ_CLASSES.into_iter().filter_map(class_region).collect() }
    }

    /// The scheme called `name` in a dataset: `cnerf-9` or `celebamask-hq-19`.
    pub fn named(name: &str) -> Option<Self> {
        match name {
            "cnerf-9" => Some(Self::cnerf()),
            "celebamask-hq-19" => Some(Self::celebamask_hq()),
            _ => None,
        }
    }

    /// A scheme from class names in the order of their label values; parsers differ in order, never in names.
    /// Known are the regions' names and CelebAMask-HQ's with their common spellings.
    pub fn from_class_names<S: AsRef<str>>(names: &[S]) -> Result<Self> {
        if names.is_empty() || names.len() > 256 {
            return Err(Error::config("classes", format!("{} class names; give 1 to 256", names.len())));
        }
        let regions = names.iter().map(|name| {
            class_region(name.as_ref()).ok_or_else(|| {
                let known = CELEBAMASK_HQ_CLASSES.join(" ");
                Error::config(
                    "classes",
                    format!("unknown class `{}`; known are {known} and the regions", name.as_ref()),
                )
            })
        });
        Ok(Self { regions: regions.collect::<Result<_>>()? })
    }

    /// The region of a label value, if the scheme has it.
    pub fn region(&self, label: u8) -> Option<Region> {
        self.regions.get(usize::from(label)).copied()
    }

    /// Number of label values.
    pub fn len(&self) -> usize {
        self.regions.len()
    }

    /// Whether there is no label value; never true of a scheme made here.
    pub fn is_empty(&self) -> bool {
        self.regions.is_empty()
    }
}

/// The region a parser's class belongs to, by its name.
pub fn class_region(name: &str) -> Option<Region> {
    let name = name.trim().to_lowercase().replace(['-', ' '], "_");
    let side_free = ["left_", "right_", "l_", "r_"].iter().find_map(|side| name.strip_prefix(side));
    Some(match name.as_str() {
        "background" | "bg" => Region::Background,
        "face" | "skin" => Region::Face,
        "eyes" | "eye" | "glasses" | "eye_g" | "eyeglass" | "eyeglasses" | "eye_glasses" => Region::Eyes,
        "eyebrows" | "eyebrow" | "brow" | "brows" => Region::Eyebrows,
        "mouth" | "u_lip" | "l_lip" | "upper_lip" | "lower_lip" | "inner_mouth" => Region::Mouth,
        "nose" => Region::Nose,
        "ears" | "ear" | "earring" | "earrings" | "ear_r" => Region::Ears,
        "hair" | "hat" => Region::Hair,
        "neck" | "necklace" | "neck_l" | "cloth" | "clothes" | "clothing" => Region::Neck,
        _ => match side_free? {
            "eye" => Region::Eyes,
            "brow" | "eyebrow" => Region::Eyebrows,
            "ear" => Region::Ears,
            _ => return None,
        },
    })
}

/// A picture of region indices.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LabelMap {
    map: GrayImage,
}

impl LabelMap {
    /// A map of label values 0 to 8 in row order, one a pixel.
    pub fn new(width: u32, height: u32, labels: Vec<u8>) -> Result<Self> {
        let found = labels.len();
        let map = GrayImage::from_raw(width, height, labels)
            .ok_or_else(|| Error::shape("label map", [height, width], &[found]))?;
        Self::translate(map, &LabelScheme::cnerf(), Path::new("label map"))
    }

    /// Decodes a greyscale or palette PNG whose values mean what `scheme` says; `name` stands in errors.
    pub fn decode(bytes: &[u8], scheme: &LabelScheme, name: &Path) -> Result<Self> {
        Self::translate(picture::decode_indices(bytes, name)?, scheme, name)
    }

    /// Translates stored values to regions; a value the scheme does not have is refused.
    pub fn translate(mut map: GrayImage, scheme: &LabelScheme, name: &Path) -> Result<Self> {
        let width = map.width().max(1);
        for (index, label) in map.iter_mut().enumerate() {
            *label = scheme.region(*label).map(|region| region as u8).ok_or_else(|| {
                let (x, y) = (index as u32 % width, index as u32 / width);
                let largest = scheme.len().saturating_sub(1);
                let remedy = "give the class names of the maps, or mend the map";
                Error::malformed(name, format!("label {label} at ({x}, {y}), the largest is {largest}; {remedy}"))
            })?;
        }
        Ok(Self { map })
    }

    /// Width, pixels.
    pub fn width(&self) -> u32 {
        self.map.width()
    }

    /// Height, pixels.
    pub fn height(&self) -> u32 {
        self.map.height()
    }

    /// Region indices in row order.
    pub fn labels(&self) -> &[u8] {
        self.map.as_raw()
    }

    /// The map as greyscale PNG bytes.
    pub fn encode(&self) -> Result<Vec<u8>> {
        picture::encode_indices(&self.map)
    }

    /// The map mirrored left to right.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        Self { map: image::imageops::flip_horizontal(&self.map) }
    }

    /// The map painted with the regions' colours.
    pub fn colours(&self) -> RgbImage {
        RgbImage::from_fn(self.width(), self.height(), |x, y| {
            let region = Region::from_label(self.map.get_pixel(x, y).0[0]).unwrap_or(Region::Background);
            image::Rgb(region.colour())
        })
    }

    /// How many pixels each region has.
    pub fn counts(&self) -> [u64; REGION_COUNT] {
        let mut counts = [0; REGION_COUNT];
        for &label in self.labels() {
            if let Some(count) = counts.get_mut(usize::from(label)) {
                *count += 1;
            }
        }
        counts
    }

    /// Each region's share of every pixel of a picture `width` × `height`: `[9, height, width]` in row order, the
    /// nine shares of a pixel sum to 1. Areas are weighted as in [`picture::resize_area`].
    pub fn one_hot(&self, width: u32, height: u32) -> Vec<f32> {
        let (width, height) = (width as usize, height as usize);
        let columns = area_weights(self.width() as usize, width);
        let rows = area_weights(self.height() as usize, height);
        let source_width = (self.width() as usize).max(1);
        let mut shares = vec![0f32; REGION_COUNT * height * width];
        for (y, (first_row, row_weights)) in rows.iter().enumerate() {
            for (x, (first_column, column_weights)) in columns.iter().enumerate() {
                let mut pixel = [0f32; REGION_COUNT];
                for (line, row) in self.labels().chunks_exact(source_width).skip(*first_row).zip(row_weights) {
                    for (&label, column) in line.iter().skip(*first_column).zip(column_weights) {
                        if let Some(share) = pixel.get_mut(usize::from(label)) {
                            *share += row * column;
                        }
                    }
                }
                for (region, share) in pixel.into_iter().enumerate() {
                    shares[(region * height + y) * width + x] = share;
                }
            }
        }
        shares
    }

    /// The map scaled to `width` × `height`: each pixel shows the region that covers most of it.
    pub fn resized(&self, width: u32, height: u32) -> Result<Self> {
        if (width, height) == (self.width(), self.height()) {
            return Ok(self.clone());
        }
        let shares = self.one_hot(width, height);
        Self::new(width, height, largest_shares(&shares, width as usize * height as usize))
    }

    /// The map of the largest of nine masks at every pixel; `masks` is `[9, H, W]`.
    pub fn from_masks(masks: &Tensor) -> Result<Self> {
        let &[REGION_COUNT, height, width] = masks.dims() else {
            return Err(Error::shape("masks", "[9, H, W]", masks.dims()));
        };
        let masks = masks.detach().to_device(&Device::Cpu)?.to_dtype(candle_core::DType::F32)?;
        let masks = masks.flatten_all()?.to_vec1::<f32>()?;
        Self::new(width as u32, height as u32, largest_shares(&masks, width * height))
    }
}

/// The index of the largest of nine planes of `pixels` values at each pixel; the lowest index wins a tie, NaN loses.
fn largest_shares(planes: &[f32], pixels: usize) -> Vec<u8> {
    let mut best = vec![f32::NEG_INFINITY; pixels];
    let mut labels = vec![0u8; pixels];
    for (region, plane) in planes.chunks_exact(pixels.max(1)).enumerate() {
        for ((best, label), &value) in best.iter_mut().zip(&mut labels).zip(plane) {
            if value > *best {
                (*best, *label) = (value, region as u8);
            }
        }
    }
    labels
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_19_classes_map_as_the_contract_says() {
        let scheme = LabelScheme::celebamask_hq();
        assert_eq!(scheme.len(), 19);
        let expected = [
            (Region::Background, &[0u8][..]),
            (Region::Face, &[1]),
            (Region::Eyes, &[3, 4, 5]),
            (Region::Eyebrows, &[6, 7]),
            (Region::Mouth, &[10, 11, 12]),
            (Region::Nose, &[2]),
            (Region::Ears, &[8, 9, 15]),
            (Region::Hair, &[13, 14]),
            (Region::Neck, &[16, 17, 18]),
        ];
        for (region, labels) in expected {
            for &label in labels {
                assert_eq!(scheme.region(label), Some(region), "{label}");
            }
        }
        assert_eq!(scheme.region(19), None);
    }

    #[test]
    fn names_decide_and_unknown_ones_are_refused() {
        let other = ["background", "skin", "l_brow", "r_brow", "l_eye", "Right-Eye", "neck_l", "ear_r"];
        let scheme = LabelScheme::from_class_names(&other).unwrap();
        assert_eq!(scheme.region(5), Some(Region::Eyes));
        assert_eq!(scheme.region(7), Some(Region::Ears));
        let error = LabelScheme::from_class_names(&["background", "tail"]).unwrap_err().to_string();
        assert!(error.contains("unknown class `tail`"), "{error}");
        assert!(LabelScheme::from_class_names::<&str>(&[]).is_err());
    }

    #[test]
    fn shares_are_areas_and_sum_to_one() {
        let map = LabelMap::new(4, 4, vec![0, 0, 1, 1, 0, 7, 1, 1, 8, 8, 2, 3, 8, 8, 4, 5]).unwrap();
        let shares = map.one_hot(2, 2);
        let share = |region: Region, x: usize, y: usize| shares[(region.index() * 2 + y) * 2 + x];
        assert_eq!(share(Region::Background, 0, 0), 0.75);
        assert_eq!(share(Region::Hair, 0, 0), 0.25);
        assert_eq!(share(Region::Face, 1, 0), 1.0);
        assert_eq!(share(Region::Mouth, 1, 1), 0.25);
        let uneven = map.one_hot(3, 5);
        for pixel in 0..15 {
            let sum: f32 = (0..9).map(|region| uneven[region * 15 + pixel]).sum();
            assert!((sum - 1.0).abs() < 1e-6);
        }
        assert_eq!(map.resized(2, 2).unwrap().labels(), &[0, 1, 8, 2]);
        assert_eq!(map.mirrored().mirrored(), map);
        assert_eq!(&map.mirrored().labels()[..4], &[1, 1, 0, 0]);
    }

    #[test]
    fn labels_out_of_range_name_the_file_and_the_pixel() {
        let png = picture::encode_indices(&GrayImage::from_raw(2, 1, vec![3, 9]).unwrap()).unwrap();
        let error = LabelMap::decode(&png, &LabelScheme::cnerf(), Path::new("masks/7.png")).unwrap_err().to_string();
        assert!(error.contains("masks/7.png: label 9 at (1, 0)"), "{error}");
    }

    #[test]
    fn the_largest_mask_wins() {
        let mut masks = vec![0f32; 9 * 2];
        masks[7 * 2] = 0.6;
        masks[2] = 0.4;
        masks[8 * 2 + 1] = f32::NAN;
        let map = LabelMap::from_masks(&Tensor::from_vec(masks, (9, 1, 2), &Device::Cpu).unwrap()).unwrap();
        assert_eq!(map.labels(), &[7, 0]);
    }
}
