//! What pictures are measured on: a model's portrait, or the authors' sizes with random weights and a surface.

use candle_core::{DType, Device, Tensor};
use serde::{Deserialize, Serialize};

use crate::{
    camera::Camera,
    config::{FieldConfig, GeneratorConfig},
    error::{Error, Result},
    model::generator::Generator,
    parameters::Parameters,
    render::RenderSettings,
};

/// α of the reference scene, world units: a surface a few samples thick, where the paper's first α of 0.1 is fog.
const REFERENCE_ALPHA: f64 = 0.005;

/// Whose portrait is rendered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "snake_case")]
pub enum SceneKind {
    /// A random portrait of a trained model, at the model's own render settings
    Model,
    /// The authors' sizes: width 128, style 256, 64×64 pixels, 24 samples; random weights over a sphere
    Reference,
}

/// A portrait, where it is seen from, and how it is rendered.
pub struct Scene {
    /// What it is called in reports.
    pub name: String,
    /// Its generator.
    pub generator: Generator,
    /// `[1, 9, 2, D]`.
    pub codes: Tensor,
    /// How it is rendered.
    pub settings: RenderSettings,
    /// Whether there is a portrait to see, so that a picture's closeness to the integral means something.
    pub is_trained: bool,
}

impl Scene {
    /// The random portrait `seed` of `generator`.
    pub fn of_model(generator: Generator, name: &str, seed: u64) -> Result<Self> {
        let codes = generator.codes_from_seed(seed, 0.7)?;
        let settings = generator.render_settings();
        Ok(Self { name: format!("{name}, seed {seed}"), generator, codes, settings, is_trained: true })
    }

    /// The authors' sizes, see [`SceneKind::Reference`].
    pub fn reference(seed: u64) -> Result<Self> {
        let field = FieldConfig { alpha_initial: REFERENCE_ALPHA, ..FieldConfig::paper() };
        let config =
            GeneratorConfig { field, upsampler: None, camera_deviation_rad: [0.3, 0.15], samples: 24, population: 0 };
        let generator = Generator::new(&config, &Parameters::fresh(seed, DType::F32, &Device::Cpu))?;
        let codes = generator.codes_from_seed(seed, 1.0)?;
        // The authors' upsampler reads features: so they are rendered, though there is no upsampler here.
        let settings = RenderSettings { features: true, ..generator.render_settings() };
        let name = format!("authors' sizes, random weights, seed {seed}");
        Ok(Self { name, generator, codes, settings, is_trained: false })
    }

    /// The same scene at another resolution or number of samples, where given; both at least 1.
    pub fn resized(mut self, resolution: Option<usize>, samples: Option<usize>) -> Result<Self> {
        if let Some(resolution) = resolution {
            self.settings.resolution = resolution;
        }
        if let Some(samples) = samples {
            self.settings = with_samples(&self.settings, samples);
        }
        if self.settings.resolution == 0 || self.settings.sampling.samples == 0 {
            return Err(Error::config("bench", "resolution and samples must be at least 1"));
        }
        Ok(self)
    }

    /// `[1, 6]`: a little from the side and above.
    pub fn camera(&self) -> Result<Tensor> {
        Camera::parameter_tensor(&[Camera::at(0.25, 0.1)], &Device::Cpu)
    }

    /// One line for charts.
    pub fn describe(&self) -> String {
        let RenderSettings { resolution, sampling, .. } = &self.settings;
        format!("{}, {resolution}×{resolution} rays of {} samples", self.name, sampling.samples)
    }
}

/// `settings` with `samples` samples a ray over the same range.
pub fn with_samples(settings: &RenderSettings, samples: usize) -> RenderSettings {
    let sampling = crate::render::Sampling { samples, ..settings.sampling };
    let last_interval = sampling.last_interval.map(|_| sampling.interval());
    RenderSettings { sampling: crate::render::Sampling { last_interval, ..sampling }, ..settings.clone() }
}

/// Largest and mean absolute difference of two pictures in [-1, 1], in units of the range [0, 1].
pub fn difference(found: &Tensor, expected: &Tensor) -> Result<(f64, f64)> {
    if found.dims() != expected.dims() {
        return Err(Error::shape("pictures to compare", expected.dims(), found.dims()));
    }
    let difference = ((found - expected)?.abs()? * 0.5)?.to_dtype(DType::F64)?;
    Ok((difference.max_all()?.to_scalar()?, difference.mean_all()?.to_scalar()?))
}
