//! Where the faces of a photo are: SeetaFace's funnel cascade (crate `rustface`), whose model is embedded.

use std::{io::Cursor, path::Path};

use image::{GrayImage, RgbImage, imageops};
use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    photo,
};

/// SeetaFace Detection's frontal model, as the crate `rustface` ships it (BSD-2-Clause, see the file beside it).
const MODEL: &[u8] = include_bytes!("../assets/seeta_fd_frontal_v1.0.bin");
/// The cascade's window, pixels: it finds no smaller face in the picture it is given.
const WINDOW: u32 = 40;
/// Looks at the photo, in turn, until one finds a face: the longest side of the picture the cascade is given, and
/// whether its shadows are lifted. Large faces are found in a small picture in a tenth of a second; small ones, and
/// those half turned or half in shadow, need another look.
const LOOKS: [(u32, bool); 5] = [(480, false), (320, false), (1440, false), (480, true), (1440, true)];
/// Least score of a detection. The crate's samples use 2; faces of the training photos score 3 to 60.
const LEAST_SCORE: f64 = 2.0;
/// A box narrower than this holds too few pixels to fit anything to.
pub const SMALLEST_FACE: u32 = 44;
/// A face darker than this (mean luma, in [0, 1]) is noise.
pub const LEAST_BRIGHTNESS: f64 = 0.08;

/// A detected face: a square box in the photo's pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Face {
    /// Centre of the box from the photo's left edge, pixels.
    pub centre_x: f64,
    /// Centre of the box from the photo's upper edge, pixels.
    pub centre_y: f64,
    /// Width and height of the box, pixels.
    pub width: f64,
    /// The cascade's score; 2 is doubtful, 10 is sure.
    pub score: f64,
}

/// The faces of a photo, largest first. An empty list is no error.
pub fn faces(photo: &RgbImage) -> Result<Vec<Face>> {
    let grey = photo::luma(photo)?;
    let longest = grey.width().max(grey.height());
    let mut lifted = grey.clone();
    // The square root of brightness in [0, 1].
    lifted.iter_mut().for_each(|value| *value = (f64::from(*value) * 255.0).sqrt() as u8);
    let mut looked = Vec::new();
    for (side, lift) in LOOKS {
        let side = side.min(longest);
        if looked.contains(&(side, lift)) {
            continue;
        }
        looked.push((side, lift));
        let found = faces_at(if lift { &lifted } else { &grey }, f64::from(side) / f64::from(longest))?;
        if !found.is_empty() {
            return Ok(found);
        }
    }
    Ok(Vec::new())
}

/// Faces in words, numbered as [`choose`] numbers them: where each is and how wide.
pub fn list(faces: &[Face]) -> String {
    const MOST: usize = 12;
    let one = |(number, face): (usize, &Face)| {
        format!("{number}: {:.0} pixels wide at {:.0},{:.0}", face.width, face.centre_x, face.centre_y)
    };
    let mut words: Vec<String> = faces.iter().enumerate().take(MOST).map(one).collect();
    if faces.len() > MOST {
        words.push(format!("and {} more", faces.len() - MOST));
    }
    words.join("; ")
}

/// The face numbered `index` (0 is the largest) of the photo read from `path`, and all there are.
///
/// Errors: [`Error::NoFace`], [`Error::NoSuchFace`], [`Error::FaceTooSmall`], [`Error::TooDark`].
pub fn choose(path: &Path, photo: &RgbImage, index: usize) -> Result<(Face, Vec<Face>)> {
    let found = faces(photo)?;
    if found.is_empty() {
        return Err(Error::NoFace { path: path.to_owned() });
    }
    let Some(face) = found.get(index).copied() else {
        return Err(Error::NoSuchFace { path: path.to_owned(), wanted: index, found: found.len(), list: list(&found) });
    };
    if face.width < f64::from(SMALLEST_FACE) {
        return Err(Error::FaceTooSmall {
            path: path.to_owned(),
            pixels: face.width.round() as u32,
            least: SMALLEST_FACE,
        });
    }
    let brightness = brightness(photo, &face);
    if brightness < LEAST_BRIGHTNESS {
        return Err(Error::TooDark { path: path.to_owned(), brightness, least: LEAST_BRIGHTNESS });
    }
    Ok((face, found))
}

fn faces_at(grey: &GrayImage, scale: f64) -> Result<Vec<Face>> {
    let resized = |length: u32| ((f64::from(length) * scale).round() as u32).max(1);
    let (width, height) = (resized(grey.width()), resized(grey.height()));
    if width.min(height) < WINDOW {
        return Ok(Vec::new());
    }
    let small =
        if scale < 1.0 { imageops::resize(grey, width, height, imageops::FilterType::Triangle) } else { grey.clone() };
    let model = rustface::read_model(Cursor::new(MODEL))
        .map_err(|error| Error::malformed("the embedded face detector", error))?;
    let mut detector = rustface::create_detector_with_model(model);
    detector.set_score_thresh(LEAST_SCORE);
    let mut found: Vec<Face> = detector
        .detect(&rustface::ImageData::new(small.as_raw(), width, height))
        .iter()
        .map(|face| {
            let bounds = face.bbox();
            let half = f64::from(bounds.width()) / 2.0;
            Face {
                centre_x: (f64::from(bounds.x()) + half) / scale,
                centre_y: (f64::from(bounds.y()) + f64::from(bounds.height()) / 2.0) / scale,
                width: 2.0 * half / scale,
                score: face.score(),
            }
        })
        .collect();
    found.sort_by(|a, b| b.width.total_cmp(&a.width).then(b.score.total_cmp(&a.score)));
    Ok(found)
}

/// Mean luma of the box's inside, in [0, 1].
fn brightness(photo: &RgbImage, face: &Face) -> f64 {
    let range = |centre: f64, limit: u32| {
        let first = (centre - face.width / 2.0).max(0.0) as u32;
        let last = (centre + face.width / 2.0).clamp(0.0, f64::from(limit)) as u32;
        first.min(limit)..last
    };
    let (mut sum, mut count) = (0.0, 0.0);
    for y in range(face.centre_y, photo.height()) {
        for x in range(face.centre_x, photo.width()) {
            let [red, green, blue] = photo.get_pixel(x, y).0.map(f64::from);
            sum += (0.299 * red + 0.587 * green + 0.114 * blue) / 255.0;
            count += 1.0;
        }
    }
    if count > 0.0 { sum / count } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn astronaut() -> RgbImage {
        photo::read(Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../examples/photos/astronaut.png"))).unwrap()
    }

    #[test]
    fn the_astronaut_has_one_face_where_it_is() {
        let (face, found) = choose(Path::new("astronaut.png"), &astronaut(), 0).unwrap();
        assert_eq!(found.len(), 1);
        // Eyes at (204, 101) and (248, 103), mouth at (224, 145).
        assert!((face.centre_x - 224.0).abs() < 8.0 && (face.centre_y - 117.0).abs() < 8.0, "{face:?}");
        assert!((80.0..120.0).contains(&face.width), "{face:?}");
        assert!(matches!(choose(Path::new("x"), &astronaut(), 1), Err(Error::NoSuchFace { wanted: 1, found: 1, .. })));
    }

    #[test]
    fn refusals_are_typed() {
        let path = Path::new("photo.png");
        let noise = RgbImage::from_fn(300, 200, |x, y| image::Rgb([(x * 37 % 251) as u8, (y * 91 % 241) as u8, 90]));
        assert!(matches!(choose(path, &noise, 0), Err(Error::NoFace { .. })));
        let small = imageops::resize(&astronaut(), 210, 210, imageops::FilterType::Triangle);
        assert!(matches!(choose(path, &small, 0), Err(Error::FaceTooSmall { pixels: 38..44, .. })));
        let mut dark = astronaut();
        dark.iter_mut().for_each(|value| *value /= 12);
        assert!(matches!(choose(path, &dark, 0), Err(Error::TooDark { .. } | Error::NoFace { .. })));
    }

    #[test]
    fn several_faces_come_largest_first() {
        let astronaut = astronaut();
        let mut pair = RgbImage::new(900, 512);
        let small = imageops::resize(&astronaut, 330, 330, imageops::FilterType::Triangle);
        imageops::replace(&mut pair, &small, 0, 0);
        imageops::replace(&mut pair, &astronaut, 380, 0);
        let found = faces(&pair).unwrap();
        assert_eq!(found.len(), 2, "{found:?}");
        assert!(found[0].width > found[1].width && found[0].centre_x > 500.0);
        assert!(list(&found).contains("; 1: "), "{}", list(&found));
        let error = choose(Path::new("pair.png"), &pair, 2).unwrap_err().to_string();
        assert!(error.contains("face 2") && error.contains("1: "), "{error}");
    }
}
