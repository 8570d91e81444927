//! The one error type of the core library. Every variant carries what a person needs to find the fault:
//! the path, the tensor's shape, or the option.

use std::path::{Path, PathBuf};

/// What can go wrong in `cnerf-core`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file could not be opened, read, written or renamed.
    #[error("{}: {}", path.display(), in_plain_words(error))]
    Io {
        /// The file or folder at fault.
        path: PathBuf,
        /// The operating system's word. Not this error's source: the message says it already.
        error: std::io::Error,
    },
    /// A file was read but is not what it should be. `reason` says what is wrong and what to do.
    #[error("{}: {reason}", path.display())]
    Malformed {
        /// The file at fault.
        path: PathBuf,
        /// What is wrong with it, and the remedy.
        reason: String,
    },
    /// A tensor has another shape than its use demands.
    #[error("{name}: expected shape {expected}, found {found:?}")]
    Shape {
        /// The tensor's name.
        name: String,
        /// What was expected, in words or as a shape.
        expected: String,
        /// What was found.
        found: Vec<usize>,
    },
    /// An option or configuration field has a value that cannot be used.
    #[error("{option}: {reason}")]
    Config {
        /// The option or the dotted path of the field.
        option: String,
        /// Why the value cannot be used, and what can.
        reason: String,
    },
    /// A number that must be finite is not.
    #[error("{quantity} is not finite{}", context.as_ref().map(|c| format!(" ({c})")).unwrap_or_default())]
    NotFinite {
        /// The quantity, e.g. a loss term.
        quantity: String,
        /// Where it was seen and what to do.
        context: Option<String>,
    },
    /// The tensor library's error.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// What happened to a file and what to do, without the operating system's numbers.
fn in_plain_words(error: &std::io::Error) -> String {
    use std::io::ErrorKind;
    if let Some(own) = error.get_ref() {
        return own.to_string();
    }
    match error.kind() {
        ErrorKind::NotFound => "no such file or folder; check its name".into(),
        ErrorKind::PermissionDenied => "may not be read or written; change its permissions or choose another".into(),
        ErrorKind::IsADirectory => "is a folder; name a file".into(),
        ErrorKind::NotADirectory => "a part of this path is a file and not a folder; check its name".into(),
        ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "the disk is full; make room or choose another".into(),
        ErrorKind::ReadOnlyFilesystem => "lies on a disk that is read-only; choose another place".into(),
        ErrorKind::InvalidFilename => "no name a file can have; choose another".into(),
        _ => error.to_string(),
    }
}

/// The core library's result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl From<cnerf_kernels::Error> for Error {
    fn from(error: cnerf_kernels::Error) -> Self {
        match error {
            cnerf_kernels::Error::Shape { name, expected, found } => Self::Shape { name, expected, found },
            cnerf_kernels::Error::Config { option, reason } => Self::Config { option, reason },
            cnerf_kernels::Error::Tensor(error) => Self::Tensor(error),
            error => Self::config("kernel", error),
        }
    }
}

impl Error {
    /// An [`Error::Io`] at `path`; made to be used as `.map_err(|e| Error::io(path, e))`.
    pub fn io(path: impl AsRef<Path>, error: std::io::Error) -> Self {
        Self::Io { path: path.as_ref().to_owned(), error }
    }

    /// An [`Error::Malformed`] at `path`.
    pub fn malformed(path: impl AsRef<Path>, reason: impl std::fmt::Display) -> Self {
        Self::Malformed { path: path.as_ref().to_owned(), reason: reason.to_string() }
    }

    /// An [`Error::Shape`] of the tensor called `name`.
    pub fn shape(name: impl Into<String>, expected: impl std::fmt::Debug, found: &[usize]) -> Self {
        Self::Shape { name: name.into(), expected: format!("{expected:?}"), found: found.to_vec() }
    }

    /// An [`Error::Config`] of the option called `option`.
    pub fn config(option: impl Into<String>, reason: impl std::fmt::Display) -> Self {
        Self::Config { option: option.into(), reason: reason.to_string() }
    }

    /// An [`Error::NotFinite`] without further context.
    pub fn not_finite(quantity: impl Into<String>) -> Self {
        Self::NotFinite { quantity: quantity.into(), context: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_file_is_told_once_with_the_remedy() {
        let error =
            std::fs::read("nowhere/at_all.bin").map_err(|error| Error::io("nowhere/at_all.bin", error)).unwrap_err();
        assert_eq!(error.to_string(), "nowhere/at_all.bin: no such file or folder; check its name");
        assert!(std::error::Error::source(&error).is_none(), "a chain would say it twice");
    }
}
