//! Multi-view sequences as GIF, animated PNG, MP4, a sheet, or a folder of frames.

mod gif;

use std::{
    ffi::OsStr,
    io::{Read, Seek, SeekFrom, Write},
    path::Path,
    process::{Command, Stdio},
};

use image::RgbImage;

use super::sheet::{Sheet, save_png};
use crate::{
    error::{Error, Result},
    files::write_atomically,
};

/// What a sequence of frames is written as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `.gif`: one palette of 256 colours for all frames, endless loop. Plays everywhere.
    Gif,
    /// `.apng`: exact colours, endless loop.
    AnimatedPng,
    /// `.mp4`: H.264, through the `ffmpeg` on PATH.
    Mp4,
    /// `.png`: a single frame as it is, several as a contact sheet.
    Png,
    /// No extension: a folder of `frame_0000.png` and so on.
    Folder,
}

impl Format {
    /// The format that a file's name asks for.
    ///
    /// # Errors
    /// [`Error::Config`] for an extension that is not known.
    pub fn of(path: &Path) -> Result<Self> {
        match path.extension().map(|extension| extension.to_string_lossy().to_ascii_lowercase()).as_deref() {
            None => Ok(Self::Folder),
            Some("gif") => Ok(Self::Gif),
            Some("apng") => Ok(Self::AnimatedPng),
            Some("mp4") => Ok(Self::Mp4),
            Some("png") => Ok(Self::Png),
            Some(other) => {
                let reason = format!("`.{other}` is not known; use .gif, .apng, .mp4, .png or a folder's name");
                Err(Error::config("out", reason))
            }
        }
    }
}

/// Writes `frames`, all of one size, to `path` in the format its name asks for (see [`Format`]), whole or not at all.
/// Frames whose files lie in a folder that already exists are written one by one.
///
/// `frames_per_second` is 0.1 to 100; sheets and folders do not use it.
///
/// # Errors
/// [`Error::Config`] for no frames, another rate or extension, frames too large for the format, or an MP4 without
/// `ffmpeg` (the error says what to install); [`Error::Shape`] if frames differ in size; [`Error::Io`] if it cannot be
/// written.
pub fn save(frames: &[RgbImage], frames_per_second: f64, path: impl AsRef<Path>) -> Result<()> {
    let path = path.as_ref();
    let format = Format::of(path)?;
    let first = frames.first().ok_or_else(|| Error::config("frames", "there is nothing to write"))?;
    let size = first.dimensions();
    if let Some(other) = frames.iter().find(|frame| frame.dimensions() != size) {
        let found = [other.width() as usize, other.height() as usize];
        return Err(Error::shape("animation frame", [size.0, size.1], &found));
    }
    if !(0.1..=100.0).contains(&frames_per_second) {
        return Err(Error::config("fps", format!("{frames_per_second} is not between 0.1 and 100 frames a second")));
    }
    match format {
        Format::Gif => write_atomically(path, &gif::encode(frames, frames_per_second)?),
        Format::AnimatedPng => {
            let bytes = animated_png(frames, size, frames_per_second).map_err(|error| Error::malformed(path, error))?;
            write_atomically(path, &bytes)
        }
        Format::Mp4 => mp4(OsStr::new("ffmpeg"), frames, size, frames_per_second, path),
        Format::Png if frames.len() == 1 => save_png(first, path),
        Format::Png => frames
            .iter()
            .fold(Sheet::near_square(frames.len()), |sheet, frame| sheet.push(frame.clone(), ""))
            .save(path),
        Format::Folder => folder(frames, path),
    }
}

fn folder(frames: &[RgbImage], path: &Path) -> Result<()> {
    let write = |folder: &Path| {
        let named = |index: usize| folder.join(format!("frame_{index:04}.png"));
        frames.iter().enumerate().try_for_each(|(index, frame)| save_png(frame, &named(index)))
    };
    if path.exists() {
        return write(path);
    }
    let failed = |error| Error::io(path, error);
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent).map_err(failed)?;
    // Written under another name first: a folder that is there is complete.
    let unfinished = tempfile::tempdir_in(parent).map_err(failed)?;
    let whole = unfinished.path().join("frames");
    std::fs::create_dir(&whole).map_err(failed)?;
    write(&whole)?;
    std::fs::rename(&whole, path).map_err(failed)
}

fn animated_png(frames: &[RgbImage], size: (u32, u32), rate: f64) -> std::result::Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, size.0, size.1);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_source_srgb(png::SrgbRenderingIntent::Perceptual);
    encoder.set_animated(frames.len() as u32, 0)?;
    encoder.set_frame_delay((1000.0 / rate).round() as u16, 1000)?;
    let mut writer = encoder.write_header()?;
    frames.iter().try_for_each(|frame| writer.write_image_data(frame))?;
    writer.finish()?;
    Ok(bytes)
}

/// Pipes raw frames to ffmpeg, which writes a temporary file that is renamed when it is whole.
fn mp4(program: &OsStr, frames: &[RgbImage], size: (u32, u32), rate: f64, path: &Path) -> Result<()> {
    let failed = |error| Error::io(path, error);
    let parent = path.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    std::fs::create_dir_all(parent).map_err(failed)?;
    let folder = tempfile::tempdir_in(parent).map_err(failed)?;
    let unfinished = folder.path().join("frames.mp4");
    // What ffmpeg says goes to a file: a pipe that nobody empties could stop it.
    let mut said = tempfile::tempfile_in(folder.path()).map_err(failed)?;
    let mut command = Command::new(program);
    command
        .args(["-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"])
        .args(["-s", &format!("{}x{}", size.0, size.1), "-r", &rate.to_string(), "-i", "-"])
        // Players want even sizes, 4:2:0 and the index up front.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "16", "-pix_fmt", "yuv420p"])
        .args(["-movflags", "+faststart"])
        .arg(&unfinished)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(said.try_clone().map_err(failed)?);
    let mut process = command.spawn().map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => {
            let reason = "ffmpeg, which .mp4 needs, is not on PATH: install it (e.g. `apt install ffmpeg`), or ask for \
                          .gif or .apng, which need nothing";
            Error::config("out", reason)
        }
        _ => failed(error),
    })?;
    // A write fails when ffmpeg has given up: its own words say more.
    let written = match process.stdin.take() {
        Some(mut input) => frames.iter().try_for_each(|frame| input.write_all(frame)),
        None => Ok(()),
    };
    let status = process.wait().map_err(failed)?;
    if !status.success() {
        let mut text = Vec::new();
        said.seek(SeekFrom::Start(0)).and_then(|_| said.take(4096).read_to_end(&mut text)).map_err(failed)?;
        let text = String::from_utf8_lossy(&text);
        let line = text.lines().map(str::trim).find(|line| !line.is_empty()).unwrap_or("no reason given");
        return Err(Error::malformed(path, format!("ffmpeg failed ({status}): {line}; ask for .gif or .apng instead")));
    }
    written.map_err(failed)?;
    std::fs::rename(&unfinished, path).map_err(failed)
}

#[cfg(test)]
mod tests;
