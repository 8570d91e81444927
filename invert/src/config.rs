//! How much work an inversion does: step counts, learning rates and loss weights, all in one place.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// How long to work on one photo.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Effort {
    /// The shortest: a likeness.
    Fast,
    /// A few minutes.
    #[default]
    Balanced,
    /// The longest, for the last decibel.
    Best,
}

impl Effort {
    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Balanced => "balanced",
            Self::Best => "best",
        }
    }
}

/// Everything an inversion may be told.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::Args))]
#[serde(default, deny_unknown_fields)]
pub struct InvertConfig {
    /// How long to work on a photo
    #[cfg_attr(feature = "clap", arg(long, value_enum, default_value_t = Effort::Balanced))]
    pub effort: Effort,
    /// Optimiser steps on codes and camera, in place of the effort's
    #[cfg_attr(feature = "clap", arg(long, value_name = "N"))]
    pub pivot_steps: Option<usize>,
    /// Optimiser steps on the generator's weights, in place of the effort's; 0 keeps the model as it is
    #[cfg_attr(feature = "clap", arg(long, value_name = "N"))]
    pub tune_steps: Option<usize>,
    /// Keep the first camera as it is
    #[cfg_attr(feature = "clap", arg(long))]
    pub fixed_camera: bool,
    /// Seed of every random draw.
    #[cfg_attr(feature = "clap", arg(skip))]
    pub seed: u64,
    /// Learning rates and weights of the pivot.
    #[cfg_attr(feature = "clap", arg(skip))]
    pub pivot: PivotConfig,
    /// Learning rates and weights of the tuning.
    #[cfg_attr(feature = "clap", arg(skip))]
    pub tune: TuneConfig,
}

/// How long each phase runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Steps {
    /// Pivot: one code for all rows, on rays of the field.
    pub shared: usize,
    /// Pivot: every row free, on rays of the field.
    pub free: usize,
    /// Pivot: on whole pictures at the output resolution.
    pub whole: usize,
    /// Tuning, on whole pictures.
    pub tune: usize,
    /// Rays of a step on the field alone.
    pub rays: usize,
}

impl Steps {
    /// Steps of the pivot in all.
    pub fn pivot(&self) -> usize {
        self.shared + self.free + self.whole
    }
}

impl InvertConfig {
    /// The phases' lengths. Explicit step counts keep the effort's proportions between the pivot's phases.
    pub fn steps(&self) -> Steps {
        let of_effort = match self.effort {
            Effort::Fast => Steps { shared: 22, free: 40, whole: 5, tune: 7, rays: 512 },
            Effort::Balanced => Steps { shared: 60, free: 160, whole: 24, tune: 36, rays: 1024 },
            Effort::Best => Steps { shared: 120, free: 500, whole: 100, tune: 150, rays: 2048 },
        };
        let mut steps = of_effort;
        if let Some(pivot) = self.pivot_steps {
            steps.shared = pivot * of_effort.shared / of_effort.pivot();
            steps.whole = pivot * of_effort.whole / of_effort.pivot();
            steps.free = pivot - steps.shared - steps.whole;
        }
        steps.tune = self.tune_steps.unwrap_or(of_effort.tune);
        steps
    }

    /// Refuses numbers that cannot be worked with.
    pub fn validate(&self) -> Result<()> {
        const MOST_STEPS: usize = 1_000_000;
        for (option, steps) in [("--pivot-steps", self.pivot_steps), ("--tune-steps", self.tune_steps)] {
            if steps.is_some_and(|steps| steps > MOST_STEPS) {
                return Err(Error::config(option, format!("at most {MOST_STEPS}")));
            }
        }
        if self.pivot_steps == Some(0) {
            return Err(Error::config("--pivot-steps", "at least 1"));
        }
        Ok(())
    }
}

/// The pivot's constants. Codes are optimised in whitened coordinates, in which the model's own codes have unit
/// variance; learning rates and regularisers are in those units.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PivotConfig {
    /// Adam's rate on whitened codes.
    pub code_rate: f64,
    /// Adam's rate on azimuth, elevation and roll (radians), shift (half widths) and ln zoom.
    pub camera_rate: f64,
    /// Weight of the mean absolute colour error, colours in [-1, 1].
    pub absolute: f64,
    /// Weight of the mean squared colour error.
    pub squared: f64,
    /// Weight of the perceptual distance at the output resolution.
    pub perceptual: f64,
    /// Weight of the rendered masks' squared error, if region masks are known.
    pub masks: f64,
    /// Weight of the opacity's binary cross-entropy, if region masks are known.
    pub opacity: f64,
    /// Weight of the codes' mean square: how strongly they are held to the model's distribution.
    pub prior: f64,
    /// Weight of the rows' mean squared distance from their own mean: how strongly regions are held to one person.
    pub agreement: f64,
    /// Share of the rays that go where the picture was off; the others go anywhere.
    pub focus: f64,
    /// Standard deviations that hold the camera to its first guess: angles (radians), shift, ln zoom.
    pub camera_prior: [f64; 3],
    /// Weight of that hold.
    pub camera: f64,
}

impl Default for PivotConfig {
    fn default() -> Self {
        Self {
            code_rate: 0.05,
            camera_rate: 0.004,
            absolute: 1.0,
            squared: 1.0,
            perceptual: 0.5,
            masks: 1.0,
            opacity: 0.1,
            prior: 2e-3,
            agreement: 1e-3,
            focus: 0.5,
            camera_prior: [0.08, 0.05, 0.05],
            camera: 2e-3,
        }
    }
}

/// The tuning's constants (Roich et al., "Pivotal Tuning", 2021, with the geometry held).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TuneConfig {
    /// Adam's rate on texture layers, colour and feature heads and the upsampler.
    pub texture_rate: f64,
    /// Adam's rate on shape layers, mask and distance heads.
    pub geometry_rate: f64,
    /// Weight of the original generator's pictures at nearby codes.
    pub locality: f64,
    /// How far nearby codes lie from the pivot, in whitened units.
    pub locality_distance: f64,
    /// Steps between two locality terms.
    pub locality_every: usize,
    /// Weight of the depth at off-views, held to the pivot's; errors in hundredths of world units.
    pub depth: f64,
    /// Weight of the masks at off-views, held to the pivot's.
    pub masks: f64,
    /// How far the off-views are turned, radians.
    pub off_view_rad: f64,
    /// Stop when the loss has not fallen by a share of 1/1000 for this many steps.
    pub patience: usize,
}

impl Default for TuneConfig {
    fn default() -> Self {
        Self {
            texture_rate: 1e-3,
            geometry_rate: 1e-4,
            locality: 0.3,
            locality_distance: 1.0,
            locality_every: 4,
            depth: 1.0,
            masks: 0.3,
            off_view_rad: 0.4,
            patience: 40,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn explicit_steps_keep_their_sum() {
        for pivot in [1, 7, 100, 999] {
            let config = InvertConfig { pivot_steps: Some(pivot), tune_steps: Some(3), ..InvertConfig::default() };
            assert_eq!((config.steps().pivot(), config.steps().tune), (pivot, 3));
        }
        let endless = InvertConfig { pivot_steps: Some(usize::MAX), ..InvertConfig::default() };
        assert!(endless.validate().unwrap_err().to_string().contains("--pivot-steps"));
    }
}
