//! How well a face parser finds regions and head pose, measured on portraits that name both.

use std::time::Instant;

use cnerf_core::{
    camera::Camera,
    data::{
        dataset::{Dataset, Item},
        labels::LabelMap,
    },
    eval::quality::Agreement,
    region::{REGION_COUNT, Region},
};
use image::RgbImage;
use serde::Serialize;

use crate::{align, error::Result, parser::RegionParser};

/// Width and height at which label maps are compared, pixels.
const SIDE: u32 = 128;

/// What was measured.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ParsingScore {
    /// Portraits with a label map.
    pub count: usize,
    /// Mean over the regions of the intersection over union.
    pub mean_iou: Option<f64>,
    /// Of each region, in label order; none for one that never occurs.
    pub iou: [Option<f64>; REGION_COUNT],
    /// Error of the pose that the parser reads.
    pub pose: Option<PoseError>,
    /// Error of the pose that alignment reads without a parser.
    pub alignment_pose: Option<PoseError>,
    /// The parser's time for a portrait, seconds.
    pub seconds: f64,
}

/// Mean absolute errors, radians.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct PoseError {
    /// Of the azimuth.
    pub azimuth_rad: f64,
    /// Of the elevation.
    pub elevation_rad: f64,
    /// Of the roll.
    pub roll_rad: f64,
    /// Of the direction of view: the angle between the true and the found one.
    pub direction_rad: f64,
}

impl PoseError {
    fn mean(pairs: &[(Camera, Camera)]) -> Option<Self> {
        let count = pairs.len() as f64;
        let mean = |error: fn(&Camera, &Camera) -> f64| {
            pairs.iter().map(|(expected, found)| error(expected, found).abs()).sum::<f64>() / count
        };
        (!pairs.is_empty()).then(|| Self {
            azimuth_rad: mean(|expected, found| found.azimuth_rad - expected.azimuth_rad),
            elevation_rad: mean(|expected, found| found.elevation_rad - expected.elevation_rad),
            roll_rad: mean(|expected, found| found.roll_rad - expected.roll_rad),
            direction_rad: mean(super::angle_between),
        })
    }
}

/// Parses the first `count` portraits of `dataset` that have label maps. `seen` is given each portrait, the map it
/// has and the map found, both of one size.
///
/// # Errors
/// If an item cannot be read, or the parser fails.
pub fn score_parser(
    parser: &dyn RegionParser,
    dataset: &Dataset,
    count: usize,
    seen: &mut dyn FnMut(&RgbImage, &LabelMap, &LabelMap),
) -> Result<ParsingScore> {
    let (mut agreement, mut score) = (Agreement::default(), ParsingScore::default());
    let (mut poses, mut alignment_poses) = (Vec::new(), Vec::new());
    let with_map = dataset.entries().iter().enumerate().filter(|(_, entry)| entry.mask.is_some());
    for (index, _) in with_map.take(count) {
        let Item { image, mask, camera } = dataset.item(index)?;
        let Some(expected) = mask else { continue };
        let aligned = align::already_aligned(&image, SIDE)?;
        let began = Instant::now();
        let parsed = parser.parse(&aligned.transform.cut(&image, parser.side()))?;
        score.seconds += began.elapsed().as_secs_f64();
        score.count += 1;
        let (expected, found) = (expected.resized(SIDE, SIDE)?, parsed.labels.resized(SIDE, SIDE)?);
        agreement.add(&expected, &found)?;
        if let Some(truth) = camera {
            alignment_poses.push((truth, aligned.camera));
            poses.extend(parsed.camera.map(|found| (truth, found)));
        }
        seen(&aligned.picture, &expected, &found);
    }
    score.seconds /= score.count.max(1) as f64;
    score.mean_iou = agreement.mean_iou();
    score.iou = Region::ALL.map(|region| agreement.iou(region));
    score.pose = PoseError::mean(&poses);
    score.alignment_pose = PoseError::mean(&alignment_poses);
    Ok(score)
}

#[cfg(test)]
mod tests {
    use cnerf_core::data::dataset::{DatasetWriter, EncodedItem, PhotoFormat};

    use super::*;
    use crate::parser::Parsed;

    /// Says that everything is hair and that everybody looks straight ahead.
    struct AllHair;

    impl RegionParser for AllHair {
        fn side(&self) -> u32 {
            32
        }

        fn parse(&self, portrait: &RgbImage) -> Result<Parsed> {
            let (width, height) = portrait.dimensions();
            let labels = vec![Region::Hair as u8; (width * height) as usize];
            Ok(Parsed { labels: LabelMap::new(width, height, labels)?, camera: Some(Camera::default()) })
        }
    }

    #[test]
    fn a_parser_that_sees_hair_everywhere_is_right_about_half_a_picture_of_hair() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("data");
        let mut writer = DatasetWriter::create(&path, false).unwrap();
        let portrait = RgbImage::from_pixel(64, 64, image::Rgb([120; 3]));
        let half = (0..64 * 64).map(|index| if index % 64 < 32 { Region::Hair as u8 } else { 0 }).collect();
        let labels = LabelMap::new(64, 64, half).unwrap();
        let camera = Some(Camera::at(0.2, -0.1));
        writer.add(EncodedItem::new(&portrait, Some(&labels), camera, PhotoFormat::Png).unwrap()).unwrap();
        writer.finish().unwrap();
        let dataset = Dataset::open(&path).unwrap();
        let mut seen = 0;
        let score = score_parser(&AllHair, &dataset, 5, &mut |_, _, _| seen += 1).unwrap();
        assert_eq!((score.count, seen, score.iou[Region::Hair.index()], score.iou[0]), (1, 1, Some(0.5), Some(0.0)));
        assert_eq!(score.mean_iou, Some(0.25));
        let pose = score.pose.unwrap();
        assert!((pose.azimuth_rad - 0.2).abs() < 1e-9 && (pose.elevation_rad - 0.1).abs() < 1e-9);
    }
}
