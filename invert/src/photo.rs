//! Reading photos as cameras and phones write them: any common format, turned upright, within bounds.

use std::{fs::File, io::BufReader, path::Path};

use image::{DynamicImage, GrayImage, ImageDecoder as _, ImageReader, Limits, RgbImage};

use crate::error::{Error, Result};

/// Photos with more pixels on a side are refused before they are decoded.
pub const LARGEST_SIDE: u32 = 16_384;
/// Photos with fewer pixels on a side cannot hold a usable face.
pub const SMALLEST_SIDE: u32 = 64;
/// Memory a decoder may take, bytes; a 100-megapixel photo fits.
const DECODER_MEMORY: u64 = 512 << 20;

/// Reads a photo upright: the EXIF orientation is applied and transparency is laid on mid grey.
///
/// Errors: the file cannot be opened, is no picture, has more than [`LARGEST_SIDE`] or fewer than [`SMALLEST_SIDE`]
/// pixels on a side.
pub fn read(path: &Path) -> Result<RgbImage> {
    let file = File::open(path).map_err(|error| Error::io(path, error))?;
    let refuse = |reason: image::ImageError| Error::Photo { path: path.to_owned(), reason: reason.to_string() };
    let mut reader =
        ImageReader::new(BufReader::new(file)).with_guessed_format().map_err(|error| Error::io(path, error))?;
    let mut limits = Limits::default();
    limits.max_image_width = Some(LARGEST_SIDE);
    limits.max_image_height = Some(LARGEST_SIDE);
    limits.max_alloc = Some(DECODER_MEMORY);
    reader.limits(limits);
    let mut decoder = reader.into_decoder().map_err(refuse)?;
    let orientation = decoder.orientation().map_err(refuse)?;
    let mut photo = DynamicImage::from_decoder(decoder).map_err(refuse)?;
    photo.apply_orientation(orientation);
    let (width, height) = (photo.width(), photo.height());
    if width.min(height) < SMALLEST_SIDE {
        return Err(Error::PhotoTooSmall { path: path.to_owned(), width, height, least: SMALLEST_SIDE });
    }
    Ok(if photo.color().has_alpha() { over_grey(&photo) } else { photo.into_rgb8() })
}

/// ITU-R BT.601 luma, as the detector was trained on.
pub fn luma(photo: &RgbImage) -> GrayImage {
    GrayImage::from_fn(photo.width(), photo.height(), |x, y| {
        let [red, green, blue] = photo.get_pixel(x, y).0.map(u32::from);
        image::Luma([((299 * red + 587 * green + 114 * blue + 500) / 1000) as u8])
    })
}

fn over_grey(photo: &DynamicImage) -> RgbImage {
    const GREY: u32 = 128;
    let photo = photo.to_rgba8();
    RgbImage::from_fn(photo.width(), photo.height(), |x, y| {
        let [red, green, blue, alpha] = photo.get_pixel(x, y).0.map(u32::from);
        image::Rgb([red, green, blue].map(|value| ((value * alpha + GREY * (255 - alpha) + 127) / 255) as u8))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refusals_name_the_file_and_the_fault() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("broken.png");
        assert!(matches!(read(&path), Err(Error::Core(cnerf_core::Error::Io { .. }))));
        std::fs::write(&path, b"\x89PNG\r\n\x1a\nnot a picture").unwrap();
        assert!(read(&path).unwrap_err().to_string().contains("broken.png"));
        RgbImage::new(300, 20).save(&path).unwrap();
        assert!(matches!(read(&path), Err(Error::PhotoTooSmall { width: 300, height: 20, .. })));
    }

    #[test]
    fn transparency_is_laid_on_grey() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("clear.png");
        image::RgbaImage::from_pixel(64, 64, image::Rgba([255, 0, 0, 0])).save(&path).unwrap();
        assert_eq!(read(&path).unwrap().get_pixel(3, 3).0, [128, 128, 128]);
    }
}
