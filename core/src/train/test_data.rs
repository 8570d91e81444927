//! A little dataset for the stages' tests.

use std::{path::Path, sync::Arc};

use image::RgbImage;

use crate::{
    camera::Camera,
    data::{
        dataset::{Dataset, DatasetWriter, EncodedItem, PhotoFormat},
        labels::LabelMap,
    },
    region::Region,
    rng::Stream,
};

/// Discs of a random colour on a random ground: face in the middle, hair above, background around.
pub fn dataset(folder: &Path, count: usize) -> Arc<Dataset> {
    let path = folder.join("data");
    let mut writer = DatasetWriter::create(&path, false).unwrap();
    for index in 0..count {
        let mut random = Stream::new(index as u64, &[]);
        let mut shade = || [random.below(256) as u8, random.below(256) as u8, random.below(256) as u8];
        let (ground, skin, hair) = (shade(), shade(), shade());
        let radius = 8.0 + (index % 5) as f32;
        let region = |x: u32, y: u32| {
            let inside = (x as f32 - 15.5).hypot(y as f32 - 15.5) < radius;
            if !inside {
                0
            } else if y < 12 {
                Region::Hair as u8
            } else {
                Region::Face as u8
            }
        };
        let picture = RgbImage::from_fn(32, 32, |x, y| {
            image::Rgb(match region(x, y) {
                0 => ground,
                1 => skin,
                _ => hair,
            })
        });
        let labels = (0..32 * 32).map(|pixel| region(pixel % 32, pixel / 32)).collect();
        let mask = LabelMap::new(32, 32, labels).unwrap();
        let camera = Camera::at(0.1 * index as f64 - 0.4, 0.0);
        writer.add(EncodedItem::new(&picture, Some(&mask), Some(camera), PhotoFormat::Png).unwrap()).unwrap();
    }
    writer.finish().unwrap();
    Arc::new(Dataset::open(&path).unwrap())
}
