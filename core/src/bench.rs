//! How fast and how right the suite is, measured side by side: every fast way against the plain one, both interleaved
//! in one run on one machine, beside what that machine could do at most.
//!
//! Each subject gives a serialisable report and the charts a person would look at; `cnerf bench` writes both.

use std::time::{Duration, Instant};

use rayon::prelude::*;
use serde::Serialize;

use crate::kernels::{Path, peak};

pub mod conv;
pub mod edit;
pub mod generators;
pub mod measure;
pub mod render;
pub mod scene;
pub mod sequence;
pub mod stability;
pub mod train;

/// Time that the ceiling of each instruction set is measured for.
const PEAK_DURATION: Duration = Duration::from_millis(300);

/// The machine that numbers were measured on.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Machine {
    /// The processor's own name.
    pub processor: String,
    /// Operating system and architecture.
    pub platform: String,
    /// Threads that the kernels ran on.
    pub threads: usize,
    /// The ceiling of every instruction set, the widest first.
    pub peaks: Vec<InstructionSetPeak>,
    /// 10⁹ bytes a second that all threads together read and write, copying far more than caches hold.
    pub memory_gigabytes_per_second: f64,
}

/// What one instruction set could do at most on all threads.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct InstructionSetPeak {
    /// The name of the kernels compiled for it.
    pub name: String,
    /// 10⁹ floating-point operations a second, a multiply-add counting two.
    pub gflops: f64,
}

impl Machine {
    /// Names the machine and measures its ceilings, now: a busy machine has lower ones.
    pub fn measure() -> Self {
        let peaks = peak::measure(PEAK_DURATION);
        Self {
            processor: processor(),
            platform: format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
            threads: rayon::current_num_threads(),
            peaks: peaks
                .into_iter()
                .map(|peak| InstructionSetPeak { name: peak.name.to_owned(), gflops: peak.gflops })
                .collect(),
            memory_gigabytes_per_second: copy_speed() / 1e9,
        }
    }

    /// The ceiling for `path`, 10⁹ operations a second: its own instruction set's; the widest for candle's operations,
    /// which choose for themselves; the portable one for the plain loops.
    pub fn peak_gflops(&self, path: Path) -> f64 {
        let own = self.peaks.iter().find(|peak| peak.name == path.name());
        let fallback = match path {
            Path::Composed => self.peaks.first(),
            Path::Kernel(_) => self.peaks.last(),
        };
        own.or(fallback).map_or(f64::NAN, |peak| peak.gflops)
    }

    /// One line for charts and summaries.
    pub fn describe(&self) -> String {
        format!("{}, {} threads, {}", self.processor, self.threads, self.platform)
    }
}

/// Bytes a second read and written when all threads copy 128 MiB, the best of three.
fn copy_speed() -> f64 {
    const VALUES: usize = 32 << 20;
    let (source, mut target) = (vec![1f32; VALUES], vec![0f32; VALUES]);
    let mut best = 0f64;
    for _ in 0..3 {
        let began = Instant::now();
        let share = VALUES.div_ceil(rayon::current_num_threads());
        target.par_chunks_mut(share).zip(source.par_chunks(share)).for_each(|(to, from)| to.copy_from_slice(from));
        std::hint::black_box(&target);
        best = best.max(8.0 * VALUES as f64 / began.elapsed().as_secs_f64());
    }
    best
}

/// The processor's name as the operating system tells it.
fn processor() -> String {
    let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        let line = cpuinfo.lines().find(|line| line.split(':').next().is_some_and(|key| key.trim() == name))?;
        Some(line.split_once(':')?.1.trim().to_owned())
    };
    let Some(name) = field("model name") else { return format!("unnamed {} processor", std::env::consts::ARCH) };
    // Virtual machines often hide the name; the family says at least which generation it is.
    match (field("cpu family"), field("model")) {
        (Some(family), Some(model)) => format!("{name} (family {family} model {model})"),
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_path_has_a_ceiling() {
        let machine = Machine::measure();
        assert!(!machine.processor.is_empty() && machine.threads > 0);
        for path in Path::available() {
            assert!(machine.peak_gflops(path) > 0.0, "{path:?}");
        }
    }
}
