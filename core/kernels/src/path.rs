//! Which way everything that has kernels is computed: local generators, convolutions, activations.
//!
//! A process has one path, the fastest that the processor runs or the one [`KERNEL_VARIABLE`] names. A benchmark or a
//! test that compares paths side by side overrides it for what one thread builds ([`Path::run`]); a graph's backward
//! pass stays on the path that its forward pass took.

use std::{cell::Cell, sync::OnceLock};

use crate::{Error, RegionKernel, Result, kernels, plain};

/// The environment variable that chooses a path by name.
pub const KERNEL_VARIABLE: &str = "CNERF_KERNEL";

/// A way to compute.
#[derive(Clone, Copy)]
pub enum Path {
    /// Candle's own operations and autograd: the plain path every other one is compared to.
    Composed,
    /// This kernel and the vector code of its instruction set.
    Kernel(&'static dyn RegionKernel<f32>),
}

thread_local! {
    static OVERRIDE: Cell<Option<Path>> = const { Cell::new(None) };
}

/// Puts back what was overridden, on panics too.
struct Restore(Option<Path>);

impl Drop for Restore {
    fn drop(&mut self) {
        OVERRIDE.set(self.0);
    }
}

impl Path {
    /// Every path that this processor can run: the kernels, the fastest first, then candle's operations.
    pub fn available() -> impl Iterator<Item = Self> {
        let kernels = kernels().filter(|kernel| kernel.available()).map(Self::Kernel);
        kernels.chain([Self::Composed])
    }

    /// The name that [`KERNEL_VARIABLE`] selects it by.
    pub fn name(self) -> &'static str {
        match self {
            Self::Composed => "composed",
            Self::Kernel(kernel) => kernel.name(),
        }
    }

    /// The path called `name`.
    ///
    /// # Errors
    /// If there is none here of that name.
    pub fn named(name: &str) -> Result<Self> {
        Self::available().find(|path| path.name() == name).ok_or_else(|| {
            let names: Vec<_> = Self::available().map(Self::name).collect();
            let reason = format!("no kernel `{name}` on this processor; use one of {}", names.join(", "));
            Error::config(KERNEL_VARIABLE, reason)
        })
    }

    /// The fastest that this processor can run.
    pub fn fastest() -> Self {
        Self::available().next().unwrap_or(Self::Composed)
    }

    /// The path of this thread: what [`Path::run`] set, else the process's.
    ///
    /// # Errors
    /// If [`KERNEL_VARIABLE`] names no path of this processor.
    pub fn current() -> Result<Self> {
        static OF_PROCESS: OnceLock<Path> = OnceLock::new();
        if let Some(path) = OVERRIDE.get().or_else(|| OF_PROCESS.get().copied()) {
            return Ok(path);
        }
        let path = match std::env::var_os(KERNEL_VARIABLE) {
            Some(name) => Self::named(&name.to_string_lossy())?,
            None => Self::fastest(),
        };
        Ok(*OF_PROCESS.get_or_init(|| path))
    }

    /// Whether candle's own operations are to be used.
    ///
    /// # Errors
    /// As [`Path::current`].
    pub fn is_composed() -> Result<bool> {
        Ok(matches!(Self::current()?, Self::Composed))
    }

    /// Does `work` on this path, whatever the process's is. Only what this thread builds counts, not what `work` hands to
    /// other threads to build.
    pub fn run<R>(self, work: impl FnOnce() -> R) -> R {
        let _restore = Restore(OVERRIDE.replace(Some(self)));
        work()
    }
}

impl std::fmt::Debug for Path {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// The kernel of the current path; where a kernel must be named though the path is candle's, the reference.
///
/// # Errors
/// As [`Path::current`].
pub fn selected() -> Result<&'static dyn RegionKernel<f32>> {
    Ok(match Path::current()? {
        Path::Kernel(kernel) => kernel,
        Path::Composed => &plain::Plain,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_chosen_by_name_and_overridden_in_a_scope() {
        for name in ["plain", "portable", "composed"] {
            let path = Path::named(name).unwrap();
            assert_eq!(path.run(|| Path::current().unwrap().name()), name);
        }
        let message = Path::named("fpga").map(Path::name).unwrap_err().to_string();
        assert!(message.starts_with("CNERF_KERNEL: no kernel `fpga`") && message.contains("portable"), "{message}");
        let outside = Path::current().unwrap().name();
        let panicked = std::panic::catch_unwind(|| Path::Composed.run(|| panic!("inside")));
        assert!(panicked.is_err());
        assert_eq!(Path::current().unwrap().name(), outside);
    }
}
