//! What a trainer tells whoever listens. It draws no bars and prints nothing itself.

use std::path::PathBuf;

use candle_core::{DType, Tensor};
use serde::Serialize;

use crate::{
    error::{Error, Result},
    train::config::Stage,
};

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

impl StepReport {
    /// Everything measured, each under `stage/name`.
    pub fn scalars(&self) -> Vec<(String, f64)> {
        let stage = format!("{:?}", self.stage).to_lowercase();
        let seconds = [("seconds", self.seconds)];
        self.metrics.0.iter().chain(&seconds).map(|(name, value)| (format!("{stage}/{name}"), *value)).collect()
    }
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

    /// Adds the value of a loss.
    pub fn push_loss(&mut self, name: &'static str, loss: &Tensor) -> Result<()> {
        self.push(name, f64::from(loss.to_dtype(DType::F32)?.to_scalar::<f32>()?));
        Ok(())
    }

    /// The first number that is not finite.
    pub fn first_not_finite(&self) -> Option<&'static str> {
        self.0.iter().find(|(_, value)| !value.is_finite()).map(|(name, _)| *name)
    }

    /// An error that names the first loss that is not finite.
    pub fn check_finite(&self) -> Result<()> {
        match self.first_not_finite() {
            Some(quantity) => Err(Error::not_finite(format!("loss term {quantity}"))),
            None => Ok(()),
        }
    }
}

impl Serialize for Metrics {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().copied())
    }
}
