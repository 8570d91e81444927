//! How long a run will take and how much memory it needs, from a step of each stage that is done and thrown away.

use std::time::Instant;

use serde::Serialize;

use crate::{
    bench::measure::peak_rss_bytes,
    error::Result,
    train::{
        config::{Stage, TrainConfig},
        trainer::{Inputs, Start, begin, stages, steps},
    },
};

/// What a stage will cost on this machine: a step with one portrait is measured and scaled by the batch, so that even
/// settings for a large machine are estimated in a minute. Periodic penalties (path length, lazy R1) are not in it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// The stage.
    pub stage: Stage,
    /// Its steps.
    pub steps: usize,
    /// Seconds of each.
    pub seconds_a_step: f64,
    /// Seconds of all.
    pub seconds: f64,
    /// Most memory held, bytes; none where the system does not tell.
    pub memory_bytes: Option<u64>,
}

/// Estimates every stage of a run; one that cannot begin, e.g. for want of LPIPS weights, gives the reason instead.
/// Nothing is written.
pub fn estimate(config: &TrainConfig, stage: Stage, inputs: &Inputs) -> Result<Vec<(Stage, Result<Estimate>)>> {
    let mut start = inputs.start.clone();
    let mut estimates = Vec::new();
    for stage in stages(config, stage)? {
        let estimated = of_stage(config, stage, inputs, start.as_ref());
        estimates.push((
            stage,
            estimated.map(|(estimate, finished)| {
                start = Some(finished);
                estimate
            }),
        ));
    }
    Ok(estimates)
}

fn of_stage(config: &TrainConfig, stage: Stage, inputs: &Inputs, start: Option<&Start>) -> Result<(Estimate, Start)> {
    let mut small = config.clone();
    let batches = [&mut small.warmup.batch, &mut small.field.batch, &mut small.upsampler.batch];
    batches.into_iter().for_each(|batch| *batch = 1);
    // Without pairs these are the whole batch.
    small.upsampler.random_portraits = small.upsampler.random_portraits.min(1);
    let batch = |config: &TrainConfig| match stage {
        Stage::Warmup => config.warmup.batch,
        Stage::Field => config.field.batch,
        Stage::Upsampler | Stage::All => config.upsampler.batch.max(config.upsampler.random_portraits),
    };
    let scale = batch(config) as f64;
    let mut run = begin(stage, &small, inputs, start)?;
    let before = peak_rss_bytes();
    let began = Instant::now();
    // The first step would have every periodic penalty, and a discriminator may run ahead alone.
    run.step(1 + config.upsampler.discriminator_ahead_steps)?;
    let seconds_a_step = began.elapsed().as_secs_f64() * scale;
    let memory_bytes =
        before.zip(peak_rss_bytes()).map(|(before, after)| before + ((after - before) as f64 * scale) as u64);
    let steps = steps(config, stage);
    let estimate = Estimate { stage, steps, seconds_a_step, seconds: seconds_a_step * steps as f64, memory_bytes };
    Ok((estimate, run.finished()?))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use candle_core::Device;

    use super::*;
    use crate::train::{config::Preset, team::Team, test_data::dataset};

    #[test]
    fn every_stage_is_estimated_or_says_why_not() {
        let folder = tempfile::tempdir().unwrap();
        let mut config = TrainConfig::preset(Preset::Tiny);
        config.field.steps = 3;
        let dataset = dataset(folder.path(), 9);
        let inputs = Inputs {
            dataset: Arc::clone(&dataset),
            perceptual: None,
            start: None,
            device: Device::Cpu,
            team: Team::default(),
        };
        let estimates = estimate(&config, Stage::All, &inputs).unwrap();
        assert_eq!(estimates.iter().map(|(stage, _)| *stage).collect::<Vec<_>>(), stages(&config, Stage::All).unwrap());
        for (stage, estimate) in estimates {
            let estimate = estimate.unwrap();
            assert_eq!((estimate.stage, estimate.steps), (stage, steps(&config, stage)));
            assert!((estimate.seconds / estimate.steps as f64 - estimate.seconds_a_step).abs() < 1e-9);
            assert!(estimate.seconds_a_step > 0.0 && estimate.memory_bytes.is_none_or(|bytes| bytes > 1 << 20));
        }
        config.upsampler.perceptual = 1.0;
        let estimates = estimate(&config, Stage::Upsampler, &inputs).unwrap();
        assert!(estimates[0].1.as_ref().unwrap_err().to_string().contains("needs a trained field"));
    }
}
