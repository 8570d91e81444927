use std::{fs::File, io::BufReader};

use image::{AnimationDecoder, ImageDecoder, Rgb, codecs::gif::GifDecoder, codecs::png::PngDecoder};

use super::*;

/// A shaded ball that moves over a still gradient: skin tones, smooth ramps and a dark corner.
fn ball(frame: u32, frames: u32) -> RgbImage {
    let centre = 32.0 + 48.0 * f64::from(frame) / f64::from(frames);
    RgbImage::from_fn(112, 80, |x, y| {
        let (dx, dy) = (f64::from(x) - centre, f64::from(y) - 40.0);
        let height = 1.0 - (dx * dx + dy * dy) / 576.0;
        if height > 0.0 {
            let light = (0.35 * height.sqrt() - 0.012 * dx - 0.012 * dy + 0.5).clamp(0.0, 1.0);
            Rgb([light * 240.0, light * 190.0, light * 160.0].map(|channel| channel as u8))
        } else {
            Rgb([20 + x as u8, 30 + y as u8, 90])
        }
    })
}

fn mean_square(a: &RgbImage, b: &RgbImage) -> f64 {
    a.iter().zip(b.iter()).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>() / a.len() as f64
}

/// Mean over blocks of 4 x 4: what the eye sees of a dithered picture.
fn blurred(picture: &RgbImage) -> RgbImage {
    image::imageops::thumbnail(picture, picture.width() / 4, picture.height() / 4)
}

#[test]
fn a_gif_has_its_frames_its_pace_and_close_colours() {
    let frames: Vec<_> = (0..12).map(|frame| ball(frame, 12)).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ball.gif");
    save(&frames, 30.0, &path).unwrap();
    let decoder = GifDecoder::new(BufReader::new(File::open(&path).unwrap())).unwrap();
    let read = decoder.into_frames().collect_frames().unwrap();
    assert_eq!(read.len(), 12);
    let total: f64 =
        read.iter().map(|frame| frame.delay().numer_denom_ms()).map(|(n, d)| f64::from(n) / f64::from(d)).sum();
    assert_eq!(total, 400.0, "12 frames at 30 a second");
    let read: Vec<_> = read.iter().map(|frame| image::DynamicImage::from(frame.buffer().clone()).to_rgb8()).collect();
    for (frame, read) in frames.iter().zip(&read) {
        let (error, seen) = (mean_square(frame, read), mean_square(&blurred(frame), &blurred(read)));
        assert!(error < 25.0 && seen < 4.0, "squared error {error}, {seen} seen from afar");
    }
    // Still pixels stay still.
    let corner = |picture: &RgbImage| (0..80).map(|y| picture.get_pixel(2, y).0).collect::<Vec<_>>();
    assert!(read.iter().all(|frame| corner(frame) == corner(&read[0])));
    let again = folder.path().join("again.gif");
    save(&frames, 30.0, &again).unwrap();
    assert_eq!(std::fs::read(path).unwrap(), std::fs::read(again).unwrap());
}

#[test]
fn few_colours_are_kept_exactly() {
    let frames: Vec<_> = (0..3u8).map(|frame| RgbImage::from_pixel(9, 7, Rgb([frame, 200, 7]))).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flat.gif");
    save(&frames, 10.0, &path).unwrap();
    let read =
        GifDecoder::new(BufReader::new(File::open(&path).unwrap())).unwrap().into_frames().collect_frames().unwrap();
    for (frame, read) in frames.iter().zip(read) {
        assert_eq!(*frame, image::DynamicImage::from(read.into_buffer()).to_rgb8());
    }
}

#[test]
fn an_animated_png_is_exact() {
    let frames: Vec<_> = (0..4).map(|frame| ball(frame, 4)).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ball.apng");
    save(&frames, 25.0, &path).unwrap();
    let decoder = PngDecoder::new(BufReader::new(File::open(&path).unwrap())).unwrap();
    assert_eq!(decoder.dimensions(), (112, 80));
    let read = decoder.apng().unwrap().into_frames().collect_frames().unwrap();
    assert_eq!(read.len(), 4);
    for (frame, read) in frames.iter().zip(read) {
        assert_eq!(read.delay().numer_denom_ms(), (40, 1));
        assert_eq!(*frame, image::DynamicImage::from(read.into_buffer()).to_rgb8());
    }
}

#[test]
fn a_png_is_a_picture_or_a_sheet_and_a_bare_name_a_folder() {
    let frames: Vec<_> = (0..5).map(|frame| ball(frame, 5)).collect();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("one.png");
    save(&frames[..1], 10.0, &path).unwrap();
    assert_eq!(image::open(&path).unwrap().to_rgb8(), frames[0]);
    save(&frames, 10.0, &path).unwrap();
    assert_eq!(image::open(&path).unwrap().width(), 4 + 3 * 116);
    let path = folder.path().join("deep/frames");
    for _ in 0..2 {
        save(&frames, 10.0, &path).unwrap();
        assert_eq!(std::fs::read_dir(&path).unwrap().count(), 5);
        assert_eq!(image::open(path.join("frame_0004.png")).unwrap().to_rgb8(), frames[4]);
    }
    let left: Vec<_> = std::fs::read_dir(folder.path().join("deep")).unwrap().collect();
    assert_eq!(left.len(), 1, "nothing temporary is left");
}

#[test]
fn what_cannot_be_written_says_why() {
    let frames = [ball(0, 2), ball(1, 2)];
    let folder = tempfile::tempdir().unwrap();
    let fails = |frames: &[RgbImage], rate: f64, name: &str| {
        let error = save(frames, rate, folder.path().join(name)).unwrap_err().to_string();
        assert!(!folder.path().join(name).exists() && !error.contains('\n'));
        error
    };
    assert!(fails(&frames, 10.0, "x.webm").contains("`.webm` is not known"));
    assert!(fails(&[], 10.0, "x.gif").contains("nothing to write"));
    assert!(fails(&frames, f64::NAN, "x.gif").starts_with("fps"));
    assert!(fails(&[RgbImage::new(70_000, 1)], 10.0, "x.gif").contains("too large for a GIF"));
    assert!(fails(&[ball(0, 1), RgbImage::new(2, 2)], 10.0, "x.gif").contains("expected shape"));
    let path = folder.path().join("x.mp4");
    let error = mp4(OsStr::new("no-such-ffmpeg"), &frames, (112, 80), 10.0, &path).unwrap_err().to_string();
    assert!(error.contains("install it"), "{error}");
}

/// A stand-in for ffmpeg shows what it is given and how its failure is told.
#[cfg(unix)]
#[test]
fn an_mp4_is_what_ffmpeg_makes_of_the_frames() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let script = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
        path
    };
    let frames = [ball(0, 2), ball(1, 2)];
    let path = folder.path().join("out.mp4");
    let copies = script("copies", "#!/bin/sh\nfor last; do :; done\necho \"$@\" > \"$last\"\ncat >> \"$last\"\n");
    mp4(copies.as_os_str(), &frames, (112, 80), 12.5, &path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let raw: usize = frames.iter().map(|frame| frame.len()).sum();
    let (line, data) = bytes.split_at(bytes.len() - raw);
    assert!(String::from_utf8_lossy(line).contains("-s 112x80 -r 12.5 -i -"));
    assert_eq!(data, [frames[0].as_raw().as_slice(), frames[1].as_raw()].concat());

    let fails = script("fails", "#!/bin/sh\necho 'Unknown encoder libx264' >&2\nexit 1\n");
    let path = folder.path().join("none.mp4");
    let error = mp4(fails.as_os_str(), &frames, (112, 80), 12.5, &path).unwrap_err().to_string();
    assert!(error.contains("Unknown encoder libx264") && !path.exists(), "{error}");
}
