//! What can go wrong in a kernel: its inputs' shapes, the choice of kernel, or candle.

/// What can go wrong in `cnerf-kernels`.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
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
    /// An option has a value that cannot be used.
    #[error("{option}: {reason}")]
    Config {
        /// The option, or the dotted path of the configuration field.
        option: String,
        /// Why the value cannot be used, and what can.
        reason: String,
    },
    /// The tensor library's error.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// The kernels' result.
pub type Result<T, E = Error> = std::result::Result<T, E>;

impl Error {
    /// An [`Error::Shape`] of the tensor called `name`.
    pub fn shape(name: impl Into<String>, expected: impl std::fmt::Debug, found: &[usize]) -> Self {
        Self::Shape { name: name.into(), expected: format!("{expected:?}"), found: found.to_vec() }
    }

    /// An [`Error::Config`] of the option called `option`.
    pub fn config(option: impl Into<String>, reason: impl std::fmt::Display) -> Self {
        Self::Config { option: option.into(), reason: reason.to_string() }
    }
}
