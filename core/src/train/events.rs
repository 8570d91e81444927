//! What a trainer tells whoever listens. It draws no bars and prints nothing itself.

use std::path::PathBuf;

use serde::Serialize;

use crate::train::config::Stage;

/// Something that happened during a run.
#[derive(Clone, Debug)]
pub enum Event {
    /// A stage begins, or continues at `step`.
    Stage {
        /// The stage.
        stage: Stage,
        /// Steps already done.
        step: usize,
        /// Steps in all.
        total: usize,
    },
    /// An optimiser step was done.
    Step(StepReport),
    /// A checkpoint was written.
    Checkpoint(PathBuf),
    /// A grid of samples was written.
    Samples(PathBuf),
    /// The model was written.
    Model(PathBuf),
    /// Something failed that the run survives, e.g. a sample grid that could not be written.
    Warning(String),
}

/// One line of `log.jsonl`.
#[derive(Clone, Debug, Serialize)]
pub struct StepReport {
    /// The stage.
    pub stage: Stage,
    /// Steps done in this stage.
    pub step: usize,
    /// Steps of this stage in all.
    pub total: usize,
    /// Seconds the step took.
    pub seconds: f64,
    /// Losses and norms by name, unweighted.
    pub metrics: Metrics,
}

/// Named numbers of a step in the order they were taken.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metrics(pub Vec<(&'static str, f64)>);

impl Metrics {
    /// Adds a number.
    pub fn push(&mut self, name: &'static str, value: f64) {
        self.0.push((name, value));
    }

    /// The number called `name`.
    pub fn get(&self, name: &str) -> Option<f64> {
        self.0.iter().find(|(known, _)| *known == name).map(|(_, value)| *value)
    }

    /// The first number that is not finite.
    pub fn first_not_finite(&self) -> Option<&'static str> {
        self.0.iter().find(|(_, value)| !value.is_finite()).map(|(name, _)| *name)
    }
}

impl Serialize for Metrics {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().copied())
    }
}
