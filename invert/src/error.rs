//! The error type of the inversion library: what a person needs to mend the photo, the portrait or the option.

use std::path::{Path, PathBuf};

/// What can go wrong in `cnerf-invert`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The core library's error.
    #[error(transparent)]
    Core(#[from] cnerf_core::Error),
    /// A photo has fewer pixels than any face needs.
    #[error("{}: {width}x{height} pixels are too few; a photo needs at least {least} on each side", path.display())]
    PhotoTooSmall {
        /// The photo.
        path: PathBuf,
        /// Its width, pixels.
        width: u32,
        /// Its height, pixels.
        height: u32,
        /// The least width and height, pixels.
        least: u32,
    },
    /// The detector found nobody.
    #[error("{}: no face found; use a photo that shows one from the front, or --aligned if it is a portrait crop already", path.display())]
    NoFace {
        /// The photo.
        path: PathBuf,
    },
    /// There are faces, but not the one asked for.
    #[error("{}: face {wanted} asked for, but only {found} found ({list})", path.display())]
    NoSuchFace {
        /// The photo.
        path: PathBuf,
        /// The index asked for.
        wanted: usize,
        /// How many there are.
        found: usize,
        /// What [`crate::detect::list`] says of them.
        list: String,
    },
    /// The chosen face covers too few pixels to show anything.
    #[error("{}: the face is {pixels} pixels wide; at least {least} are needed: crop from a larger original", path.display())]
    FaceTooSmall {
        /// The photo.
        path: PathBuf,
        /// Width of the detector's box, pixels.
        pixels: u32,
        /// The least width, pixels.
        least: u32,
    },
    /// The chosen face is too dark to fit.
    #[error("{}: the face is too dark (mean brightness {brightness:.2}, at least {least:.2} needed): brighten the photo first", path.display())]
    TooDark {
        /// The photo.
        path: PathBuf,
        /// Mean luma inside the detector's box, in [0, 1].
        brightness: f64,
        /// The least mean luma.
        least: f64,
    },
    /// A portrait file was made with another model than the one at hand.
    #[error("{}: made with model `{name}` (hash {wanted}), but the model given has hash {found}: pass the model it was made with by --model", path.display())]
    WrongModel {
        /// The portrait file.
        path: PathBuf,
        /// The name the portrait gives its model.
        name: String,
        /// The hash in the portrait file.
        wanted: String,
        /// The hash of the model at hand.
        found: String,
    },
    /// There is no edit to take back.
    #[error("{}: has no edit to undo", path.display())]
    NothingToUndo {
        /// The portrait file.
        path: PathBuf,
    },
}

/// The inversion library's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// A core error that says `path` is not what it should be.
    pub(crate) fn malformed(path: impl AsRef<Path>, reason: impl std::fmt::Display) -> Self {
        cnerf_core::Error::malformed(path, reason).into()
    }

    /// A core error about reading or writing `path`.
    pub(crate) fn io(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        cnerf_core::Error::io(path, source).into()
    }

    /// A core error about an option.
    pub(crate) fn config(option: impl Into<String>, reason: impl std::fmt::Display) -> Self {
        cnerf_core::Error::config(option, reason).into()
    }
}

impl From<candle_core::Error> for Error {
    fn from(error: candle_core::Error) -> Self {
        Self::Core(error.into())
    }
}
