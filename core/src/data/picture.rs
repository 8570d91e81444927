//! Reading and writing pictures without trusting them.
//!
//! Bytes come from users and from archives: sizes are checked before anything is allocated, truncated files are
//! refused, and every error names the file and what to do. Pictures are sRGB bytes as stored; tensors are f32 NCHW
//! in [-1, 1].

use std::{
    fs::File,
    io::{Cursor, Read as _},
    path::Path,
};

use candle_core::{DType, Device, Tensor};
use image::{
    DynamicImage, ExtendedColorType, ImageDecoder as _, ImageEncoder as _, ImageFormat, ImageReader, Limits,
    codecs::{jpeg::JpegEncoder, png::PngEncoder},
};
pub use image::{GrayImage, RgbImage};

use crate::error::{Error, Result};
pub use crate::files::write_atomically as write_file;

/// Largest width and height of a picture that is read, pixels.
pub const MAX_SIDE: u32 = 8192;
/// Largest file that is read as one picture, bytes.
pub const MAX_FILE_BYTES: u64 = 256 << 20;
/// Largest memory one decoder may take: 8192² pixels of 16-bit RGBA and some room to work in.
const MAX_DECODER_BYTES: u64 = 640 << 20;

/// Reads a whole file of at most `limit` bytes.
pub fn read_file(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|error| Error::io(path, error))?;
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(|error| Error::io(path, error))?;
    if bytes.len() as u64 > limit {
        return Err(Error::malformed(
            path,
            format!("larger than the {} MiB that are read of such a file", limit >> 20),
        ));
    }
    Ok(bytes)
}

/// Reads a photo (PNG, JPEG, WebP, BMP or GIF), upright as its EXIF orientation says; see [`decode`].
pub fn read(path: &Path) -> Result<RgbImage> {
    decode(&read_file(path, MAX_FILE_BYTES)?, path)
}

/// Decodes a photo (PNG, JPEG, WebP, BMP or GIF: its first frame); `name` stands in errors.
///
/// EXIF orientation is applied, 16-bit channels are reduced to 8, transparency is laid over white. Refused: other
/// formats, more than [`MAX_SIDE`] pixels a side, truncated or damaged data.
pub fn decode(bytes: &[u8], name: &Path) -> Result<RgbImage> {
    let refuse = |error: &dyn std::fmt::Display| undecodable(name, error);
    let format = image::guess_format(bytes).map_err(|_| {
        let reason = if bytes.is_empty() { "the file is empty" } else { "not a picture this program knows" };
        Error::malformed(name, format!("{reason}; give a PNG, JPEG, WebP, BMP or GIF file"))
    })?;
    match format {
        ImageFormat::Png => check_png_header(bytes, name)?,
        ImageFormat::Jpeg => check_jpeg_is_whole(bytes, name)?,
        _ => {}
    }
    let mut limits = Limits::default();
    limits.max_alloc = Some(MAX_DECODER_BYTES);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits.clone());
    let mut decoder = reader.into_decoder().map_err(|error| refuse(&error))?;
    let (width, height) = decoder.dimensions();
    check_size(width, height, name)?;
    limits.reserve(decoder.total_bytes()).map_err(|error| refuse(&error))?;
    // A photo with an unreadable orientation is taken as it is stored.
    let orientation = decoder.orientation().ok();
    let mut picture = DynamicImage::from_decoder(decoder).map_err(|error| refuse(&error))?;
    if let Some(orientation) = orientation {
        picture.apply_orientation(orientation);
    }
    Ok(over_white(picture))
}

/// Decodes an 8-bit map: a greyscale PNG's values or a palette PNG's indices, as stored; `name` stands in errors.
///
/// Grey values of fewer than 8 bits are not scaled. Colour PNGs whose three channels are equal count as greyscale.
pub fn decode_indices(bytes: &[u8], name: &Path) -> Result<GrayImage> {
    if image::guess_format(bytes).ok() != Some(ImageFormat::Png) {
        return Err(Error::malformed(name, "a label map must be a PNG: lossy formats change labels"));
    }
    check_png_header(bytes, name)?;
    let mut decoder =
        png::Decoder::new_with_limits(Cursor::new(bytes), png::Limits { bytes: MAX_DECODER_BYTES as usize });
    decoder.set_transformations(png::Transformations::IDENTITY);
    let mut reader = decoder.read_info().map_err(|error| undecodable(name, &error))?;
    let (width, height) = (reader.info().width, reader.info().height);
    check_size(width, height, name)?;
    let size = reader.output_buffer_size().ok_or_else(|| undecodable(name, &"too large"))?;
    let mut stored = vec![0; size];
    let frame = reader.next_frame(&mut stored).map_err(|error| undecodable(name, &error))?;
    let row = frame.line_size.max(1);
    let width_pixels = width as usize;
    let bits = frame.bit_depth as usize;
    let channels = frame.color_type.samples();
    let mut values = Vec::with_capacity(width_pixels * height as usize);
    for line in stored.chunks_exact(row).take(height as usize) {
        match (channels, bits) {
            (1, 8) => values.extend_from_slice(&line[..width_pixels.min(line.len())]),
            (1, 1 | 2 | 4) => {
                let per_byte = 8 / bits;
                let mask = (1u8 << bits) - 1;
                let pixels = line
                    .iter()
                    .flat_map(|byte| (0..per_byte).map(move |index| (byte >> (8 - bits * (index + 1))) & mask));
                values.extend(pixels.take(width_pixels));
            }
            (2, 8) => values.extend(line.chunks_exact(2).map(|pixel| pixel[0])),
            (3 | 4, 8) => {
                for pixel in line.chunks_exact(channels) {
                    if pixel[0] != pixel[1] || pixel[1] != pixel[2] {
                        let remedy = "store region indices as an 8-bit greyscale or palette PNG";
                        return Err(Error::malformed(name, format!("a label map, but coloured; {remedy}")));
                    }
                    values.push(pixel[0]);
                }
            }
            _ => return Err(Error::malformed(name, "a label map must have 8 bits or fewer a pixel")),
        }
    }
    GrayImage::from_raw(width, height, values).ok_or_else(|| undecodable(name, &"fewer rows than its header says"))
}

fn over_white(picture: DynamicImage) -> RgbImage {
    if !picture.color().has_alpha() {
        return picture.into_rgb8();
    }
    let picture = picture.into_rgba8();
    RgbImage::from_fn(picture.width(), picture.height(), |x, y| {
        let [colour @ .., alpha] = picture.get_pixel(x, y).0;
        let alpha = u32::from(alpha);
        image::Rgb(colour.map(|value| ((u32::from(value) * alpha + 255 * (255 - alpha) + 127) / 255) as u8))
    })
}

fn undecodable(name: &Path, error: &dyn std::fmt::Display) -> Error {
    let error = error.to_string().replace('\n', " ");
    Error::malformed(name, format!("cannot be decoded ({error}); it is truncated or damaged: replace the file"))
}

fn check_size(width: u32, height: u32, name: &Path) -> Result<()> {
    if width == 0 || height == 0 {
        return Err(Error::malformed(name, "a picture without pixels; replace the file"));
    }
    if width > MAX_SIDE || height > MAX_SIDE {
        let reason = format!("{width}×{height} pixels; scale it down to {MAX_SIDE}×{MAX_SIDE} or less");
        return Err(Error::malformed(name, reason));
    }
    Ok(())
}

/// The size in a PNG's header, checked before a decoder sees the file: it would read on to the first pixels.
fn check_png_header(bytes: &[u8], name: &Path) -> Result<()> {
    let number = |at: usize| bytes.get(at..at + 4)?.try_into().ok().map(u32::from_be_bytes);
    match (number(16), number(20)) {
        (Some(width), Some(height)) if bytes.get(12..16) == Some(b"IHDR") => check_size(width, height, name),
        _ => Err(undecodable(name, &"the PNG header is incomplete")),
    }
}

/// Walks a JPEG's segments to the end-of-image marker: decoders fill what is missing with grey and say nothing.
fn check_jpeg_is_whole(bytes: &[u8], name: &Path) -> Result<()> {
    let mut rest = bytes.get(2..).unwrap_or_default();
    loop {
        // Skip to the next marker: over entropy-coded data (stuffed FF 00, restarts FF D0-D7) and fill bytes.
        let Some(start) =
            rest.windows(2).position(|pair| pair[0] == 0xff && !matches!(pair[1], 0 | 0xd0..=0xd7 | 0xff))
        else {
            return Err(undecodable(name, &"the JPEG ends before its end marker"));
        };
        let marker = rest[start + 1];
        rest = &rest[start + 2..];
        if marker == 0xd9 {
            return Ok(());
        }
        if matches!(marker, 0x01 | 0xd8) {
            continue;
        }
        let length = rest.get(..2).map_or(0, |length| usize::from(u16::from_be_bytes([length[0], length[1]])));
        rest = match rest.get(length..) {
            Some(after) if length >= 2 => after,
            _ => return Err(undecodable(name, &"a JPEG segment is incomplete")),
        };
    }
}

/// A picture as PNG bytes.
pub fn encode_png(picture: &RgbImage) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(picture, picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|error| Error::malformed("PNG encoder", error))?;
    Ok(bytes)
}

/// A picture as JPEG bytes; `quality` from 1 to 100.
pub fn encode_jpeg(picture: &RgbImage, quality: u8) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality.clamp(1, 100))
        .write_image(picture, picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|error| Error::malformed("JPEG encoder", error))?;
    Ok(bytes)
}

/// An 8-bit map as greyscale PNG bytes, as [`decode_indices`] reads it.
pub fn encode_indices(map: &GrayImage) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(map, map.width(), map.height(), ExtendedColorType::L8)
        .map_err(|error| Error::malformed("PNG encoder", error))?;
    Ok(bytes)
}

/// Writes a PNG, or a JPEG (quality 95) if `path` ends in `.jpg` or `.jpeg`, whole or not at all.
pub fn write(path: &Path, picture: &RgbImage) -> Result<()> {
    let extension = path.extension().and_then(|extension| extension.to_str()).unwrap_or_default().to_lowercase();
    let bytes = match extension.as_str() {
        "png" => encode_png(picture)?,
        "jpg" | "jpeg" => encode_jpeg(picture, 95)?,
        _ => return Err(Error::malformed(path, "pictures are written as .png or .jpg; name the file so")),
    };
    write_file(path, &bytes)
}

/// Pictures of one size as a tensor `[B, 3, H, W]`, f32 in [-1, 1].
pub fn to_tensor(pictures: &[RgbImage], device: &Device) -> Result<Tensor> {
    let (width, height) =
        pictures.first().map_or((0, 0), |picture| (picture.width() as usize, picture.height() as usize));
    let mut values = Vec::with_capacity(pictures.len() * 3 * width * height);
    for picture in pictures {
        let size = [picture.height() as usize, picture.width() as usize];
        if size != [height, width] {
            return Err(Error::shape("pictures of one tensor", [height, width], &size));
        }
        for channel in 0..3 {
            values.extend(picture.as_raw().iter().skip(channel).step_by(3).map(|&value| signed(value)));
        }
    }
    Ok(Tensor::from_vec(values, (pictures.len(), 3, height, width), device)?)
}

/// Pictures of a tensor `[B, 3, H, W]` or `[3, H, W]` in [-1, 1]; values outside are clamped, NaN becomes black.
pub fn from_tensor(tensor: &Tensor) -> Result<Vec<RgbImage>> {
    let tensor = if tensor.rank() == 3 { tensor.unsqueeze(0)? } else { tensor.clone() };
    let &[count, 3, height, width] = tensor.dims() else {
        return Err(Error::shape("pictures", "[B, 3, H, W]", tensor.dims()));
    };
    let pixels = tensor.detach().to_device(&Device::Cpu)?.to_dtype(DType::F32)?.permute((0, 2, 3, 1))?;
    let bytes: Vec<u8> = pixels.flatten_all()?.to_vec1::<f32>()?.into_iter().map(unsigned).collect();
    (0..count)
        .map(|index| {
            let size = 3 * height * width;
            let picture = bytes.get(index * size..(index + 1) * size).unwrap_or_default().to_vec();
            RgbImage::from_raw(width as u32, height as u32, picture)
                .ok_or_else(|| Error::shape("picture", "[3, H, W]", tensor.dims()))
        })
        .collect()
}

/// A stored byte as a number in [-1, 1].
pub fn signed(value: u8) -> f32 {
    f32::from(value) * (2.0 / 255.0) - 1.0
}

/// A number in [-1, 1] as the nearest stored byte; clamped, NaN is 0.
pub fn unsigned(value: f32) -> u8 {
    // `as` saturates and maps NaN to 0.
    ((value + 1.0) * 127.5).round() as u8
}

/// A picture scaled to `width` × `height`: exact area averages when that makes it smaller both ways, Lanczos-3
/// otherwise.
pub fn resize(picture: &RgbImage, width: u32, height: u32) -> Result<RgbImage> {
    if width <= picture.width() && height <= picture.height() {
        resize_area(picture, width, height)
    } else {
        resize_lanczos(picture, width, height)
    }
}

/// A picture scaled by area averages: each new pixel is the mean of what it covers. The masks' counterpart is
/// [`super::labels::LabelMap::one_hot`], which weights by the same areas.
pub fn resize_area(picture: &RgbImage, width: u32, height: u32) -> Result<RgbImage> {
    check_target(width, height)?;
    if (width, height) == picture.dimensions() {
        return Ok(picture.clone());
    }
    let columns = area_weights(picture.width() as usize, width as usize);
    let rows = area_weights(picture.height() as usize, height as usize);
    let source_row = 3 * picture.width() as usize;
    let mut sums = vec![0f32; source_row];
    let mut values = Vec::with_capacity(3 * width as usize * height as usize);
    for (first_row, row_weights) in &rows {
        sums.fill(0.0);
        for (line, weight) in picture.as_raw().chunks_exact(source_row).skip(*first_row).zip(row_weights) {
            for (sum, &value) in sums.iter_mut().zip(line) {
                *sum += weight * f32::from(value);
            }
        }
        for (first_column, column_weights) in &columns {
            let mut colour = [0f32; 3];
            for (pixel, weight) in sums.chunks_exact(3).skip(*first_column).zip(column_weights) {
                for (sum, value) in colour.iter_mut().zip(pixel) {
                    *sum += weight * value;
                }
            }
            values.extend(colour.map(|value| value.round() as u8));
        }
    }
    RgbImage::from_raw(width, height, values)
        .ok_or_else(|| Error::shape("resized picture", [height, width], &[height as usize, width as usize]))
}

/// A picture scaled by the Lanczos-3 filter, widened when it shrinks so that nothing aliases.
pub fn resize_lanczos(picture: &RgbImage, width: u32, height: u32) -> Result<RgbImage> {
    check_target(width, height)?;
    // kornia-imgproc 0.2 repeats edge pixels under the filter's negative lobes: up to 13 grey levels off at borders.
    Ok(image::imageops::resize(picture, width, height, image::imageops::FilterType::Lanczos3))
}

fn check_target(width: u32, height: u32) -> Result<()> {
    if width == 0 || height == 0 || width > MAX_SIDE || height > MAX_SIDE {
        return Err(Error::config("resolution", format!("{width}×{height} is not between 1 and {MAX_SIDE} pixels")));
    }
    Ok(())
}

/// For each of `target` cells along an axis of `source` pixels: the first pixel it covers, and the share of the
/// cell that each pixel from there on fills. Shares sum to 1.
pub(crate) fn area_weights(source: usize, target: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = source as f64 / target as f64;
    (0..target)
        .map(|cell| {
            // Integers first: a cell's edges fall exactly on pixel edges whenever they do so on paper.
            let (first, last) = (cell * source / target, ((cell + 1) * source).div_ceil(target));
            let (low, high) = (cell as f64 * scale, (cell + 1) as f64 * scale);
            let share = |pixel: usize| (high.min((pixel + 1) as f64) - low.max(pixel as f64)).max(0.0) / scale;
            (first, (first..last).map(|pixel| share(pixel) as f32).collect())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Stream;

    fn noise(width: u32, height: u32) -> RgbImage {
        let mut random = Stream::new(3, &[u64::from(width), u64::from(height)]);
        RgbImage::from_fn(width, height, |_, _| image::Rgb(std::array::from_fn(|_| random.bits() as u8)))
    }

    fn smooth(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| image::Rgb([(x * 2) as u8, (y * 2) as u8, ((x + y) * 3 / 2) as u8]))
    }

    #[test]
    fn png_round_trips_and_jpeg_comes_close() {
        let picture = smooth(60, 40);
        let name = Path::new("picture");
        assert_eq!(decode(&encode_png(&picture).unwrap(), name).unwrap(), picture);
        let decoded = decode(&encode_jpeg(&picture, 95).unwrap(), name).unwrap();
        let largest = decoded.as_raw().iter().zip(picture.as_raw()).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(largest < 12, "{largest}");
    }

    #[test]
    fn every_truncation_is_refused_by_name() {
        let picture = noise(40, 30);
        let mut files = vec![encode_png(&picture).unwrap(), encode_jpeg(&picture, 90).unwrap()];
        for format in [ImageFormat::WebP, ImageFormat::Bmp, ImageFormat::Gif] {
            let mut bytes = Cursor::new(Vec::new());
            DynamicImage::from(picture.clone()).write_to(&mut bytes, format).unwrap();
            files.push(bytes.into_inner());
        }
        for bytes in files {
            decode(&bytes, Path::new("whole")).unwrap();
            for kept in [0, 1, 10, 25, 40, bytes.len() / 2, bytes.len() * 9 / 10] {
                let error = decode(&bytes[..kept], Path::new("half.png")).unwrap_err().to_string();
                assert!(error.starts_with("half.png: ") && !error.contains('\n'), "{kept}: {error}");
            }
        }
    }

    #[test]
    fn a_jpeg_cut_within_its_last_bytes_is_refused() {
        let bytes = encode_jpeg(&noise(64, 64), 90).unwrap();
        let error = decode(&bytes[..bytes.len() - 2], Path::new("cut.jpg")).unwrap_err().to_string();
        assert!(error.contains("cut.jpg") && error.contains("truncated"), "{error}");
    }

    #[test]
    fn huge_headers_are_refused_before_anything_is_allocated() {
        let mut png = encode_png(&smooth(8, 8)).unwrap();
        png[16..20].copy_from_slice(&20_000u32.to_be_bytes());
        png[20..24].copy_from_slice(&20_000u32.to_be_bytes());
        for bytes in [&png[..], &png[..33]] {
            for error in [
                decode(bytes, Path::new("huge.png")).unwrap_err(),
                decode_indices(bytes, Path::new("huge.png")).unwrap_err(),
            ] {
                let error = error.to_string();
                assert!(error.contains("huge.png: 20000×20000") && error.contains("scale it down"), "{error}");
            }
        }
        let mut bmp = Cursor::new(Vec::new());
        DynamicImage::from(smooth(8, 8)).write_to(&mut bmp, ImageFormat::Bmp).unwrap();
        let mut bmp = bmp.into_inner();
        bmp[18..22].copy_from_slice(&20_000u32.to_le_bytes());
        assert!(decode(&bmp, Path::new("huge.bmp")).unwrap_err().to_string().starts_with("huge.bmp: "));
    }

    #[test]
    fn transparency_is_laid_over_white() {
        let mut bytes = Cursor::new(Vec::new());
        let picture = image::RgbaImage::from_pixel(2, 2, image::Rgba([10, 20, 30, 0]));
        DynamicImage::from(picture).write_to(&mut bytes, ImageFormat::Png).unwrap();
        assert_eq!(decode(&bytes.into_inner(), Path::new("clear.png")).unwrap().get_pixel(0, 0).0, [255; 3]);
    }

    #[test]
    fn palette_indices_are_kept_at_every_depth() {
        for (depth, bits) in [(png::BitDepth::One, 1), (png::BitDepth::Two, 2), (png::BitDepth::Four, 4)] {
            let mut bytes = Vec::new();
            let mut encoder = png::Encoder::new(&mut bytes, 3, 2);
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_depth(depth);
            encoder.set_palette((0..3u8 << bits).map(|value| 255 - value).collect::<Vec<u8>>());
            let mut writer = encoder.write_header().unwrap();
            // Rows 1 0 1 and 0 1 1.
            let pack = |row: [u8; 3]| {
                let mut packed = vec![0u8; (3 * bits as usize).div_ceil(8)];
                for (index, value) in row.into_iter().enumerate() {
                    let at = index * bits as usize;
                    packed[at / 8] |= value << (8 - bits as usize - at % 8);
                }
                packed
            };
            writer.write_image_data(&[pack([1, 0, 1]), pack([0, 1, 1])].concat()).unwrap();
            writer.finish().unwrap();
            let map = decode_indices(&bytes, Path::new("map.png")).unwrap();
            assert_eq!(map.as_raw(), &[1, 0, 1, 0, 1, 1]);
        }
        let coloured = encode_png(&smooth(8, 8)).unwrap();
        assert!(decode_indices(&coloured, Path::new("map.png")).unwrap_err().to_string().contains("greyscale"));
    }

    #[test]
    fn area_average_is_the_mean_of_what_a_pixel_covers() {
        let picture = noise(12, 8);
        let small = resize_area(&picture, 4, 4).unwrap();
        for (x, y, pixel) in small.enumerate_pixels() {
            for channel in 0..3 {
                let covered = (0..6).map(|i| picture.get_pixel(3 * x + i % 3, 2 * y + i / 3).0[channel]);
                let mean = covered.map(f32::from).sum::<f32>() / 6.0;
                assert!((f32::from(pixel.0[channel]) - mean).abs() <= 0.5 + 1e-4);
            }
        }
        for (source, target) in [(256, 64), (100, 37), (37, 100), (7, 7), (1, 5), (5, 1)] {
            let weights = area_weights(source, target);
            assert_eq!(weights.len(), target);
            for (first, shares) in weights {
                assert!(first + shares.len() <= source);
                assert!((shares.iter().sum::<f32>() - 1.0).abs() < 1e-5);
            }
        }
    }

    /// Lanczos-3 in f64, separable, widened on reduction, edges renormalised: Pillow's definition.
    fn lanczos_f64(picture: &RgbImage, width: u32, height: u32) -> Vec<f64> {
        let sinc = |x: f64| if x == 0.0 { 1.0 } else { (std::f64::consts::PI * x).sin() / (std::f64::consts::PI * x) };
        let kernel = |x: f64| if x.abs() < 3.0 { sinc(x) * sinc(x / 3.0) } else { 0.0 };
        let axis = |source: u32, target: u32| -> Vec<Vec<f64>> {
            let scale = f64::from(source) / f64::from(target);
            let widening = scale.max(1.0);
            let cell = |cell| {
                let centre = (f64::from(cell) + 0.5) * scale;
                let weights: Vec<f64> =
                    (0..source).map(|pixel| kernel((f64::from(pixel) + 0.5 - centre) / widening)).collect();
                let sum: f64 = weights.iter().sum();
                weights.into_iter().map(|weight| weight / sum).collect()
            };
            (0..target).map(cell).collect()
        };
        let (columns, rows) = (axis(picture.width(), width), axis(picture.height(), height));
        let mut values = Vec::new();
        for row in &rows {
            for column in &columns {
                for channel in 0..3 {
                    let mut sum = 0.0;
                    for (y, row) in row.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
                        for (x, column) in column.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
                            sum += row * column * f64::from(picture.get_pixel(x as u32, y as u32).0[channel]);
                        }
                    }
                    values.push(sum.clamp(0.0, 255.0));
                }
            }
        }
        values
    }

    #[test]
    fn lanczos_agrees_with_f64() {
        for (width, height) in [(50, 50), (64, 30), (200, 170), (13, 9)] {
            for picture in [noise(100, 90), smooth(100, 90)] {
                let exact = lanczos_f64(&picture, width, height);
                let found = resize_lanczos(&picture, width, height).unwrap();
                let errors = found.as_raw().iter().zip(&exact).map(|(found, exact)| (f64::from(*found) - exact).abs());
                // Rounding to bytes is 0.5.
                assert!(errors.fold(0.0, f64::max) < 0.51, "{width}x{height}");
            }
        }
    }

    #[test]
    fn tensors_round_trip() {
        let pictures = [noise(5, 4), smooth(5, 4)];
        let tensor = to_tensor(&pictures, &Device::Cpu).unwrap();
        assert_eq!(tensor.dims(), [2, 3, 4, 5]);
        assert_eq!(from_tensor(&tensor).unwrap(), pictures);
        let odd = Tensor::new(&[[[f32::NAN, 7.0]], [[-9.0, 0.0]], [[1.0, -1.0]]], &Device::Cpu).unwrap();
        assert_eq!(from_tensor(&odd).unwrap()[0].as_raw(), &[0, 0, 255, 255, 128, 0]);
    }
}
