//! The whole generator: from noise to codes, from codes and a camera to a render, from a render to a picture.

use std::path::Path;

use candle_core::{DType, Device, Tensor};

use crate::{
    codes,
    config::{Background, GeneratorConfig, UpsamplerStyle},
    error::{Error, Result},
    model::{
        field::Field,
        file::{self, ModelHeader, Tensors},
        mapping::Mapping,
        population::Population,
        upsampler::{Noise, Upsampler, UpsamplerInput, UpsamplerOutput},
    },
    parameters::{Init, Parameters},
    render::{Frame, RenderSettings, Sampling, render_frame},
    rng::Stream,
};

/// Layers of the mapping network (paper).
const MAPPING_LAYERS: usize = 3;
/// Codes averaged for the mean w (authors: 10,000).
const MEAN_DRAWS: usize = 10_000;
/// Resolution of renders when there is no upsampler to ask.
const FIELD_RESOLUTION: usize = 64;

/// The weights under this prefix are measured, not trained.
pub const STATISTICS: &str = "statistics";

/// The generator of portraits.
#[derive(Clone)]
pub struct Generator {
    config: GeneratorConfig,
    parameters: Parameters,
    mapping: Mapping,
    field: Field,
    upsampler: Option<Upsampler>,
    /// Mean and standard deviation of the z that portraits are drawn from, `[D]` each.
    z_statistics: (Tensor, Tensor),
    /// Mean w, `[D]`.
    w_mean: Tensor,
    population: Option<Population>,
    header: Option<ModelHeader>,
    /// See [`Self::with_budget`].
    budget: f64,
}

/// A finished picture and the render under it.
#[derive(Clone, Debug)]
pub struct Picture {
    /// `[B, 3, R, R]` in [-1, 1] at the output resolution.
    pub rgb: Tensor,
    /// Region masks at the output resolution, `[B, 9, R, R]`.
    pub masks: Tensor,
    /// The render.
    pub frame: Frame,
}

impl Generator {
    /// The generator of `config` with weights from `parameters`.
    pub fn new(config: &GeneratorConfig, parameters: &Parameters) -> Result<Self> {
        let style_dim = config.field.style_dim;
        let mapping = Mapping::new(style_dim, MAPPING_LAYERS, &parameters.within("mapping"))?;
        let field = Field::new(&config.field, &parameters.within("field"))?;
        let upsampler = config
            .upsampler
            .as_ref()
            .map(|upsampler| Upsampler::new(upsampler, config.field.width, style_dim, &parameters.within("upsampler")))
            .transpose()?;
        let statistics = parameters.within(STATISTICS);
        let population = (config.population > 0)
            .then(|| Population::new(config.population, style_dim, &statistics.within("population")))
            .transpose()?;
        let statistic = |name: &str, value: f64| statistics.get(name, &[style_dim], Init::Constant(value));
        Ok(Self {
            config: config.clone(),
            parameters: parameters.clone(),
            mapping,
            field,
            upsampler,
            z_statistics: (statistic("z_mean", 0.0)?, statistic("z_deviation", 1.0)?),
            w_mean: statistic("w_mean", 0.0)?,
            population,
            header: None,
            budget: 0.0,
        })
    }

    /// The same generator whose [`Self::render_settings`] allow pictures this error, in [0, 1] colour units (see
    /// [`crate::render::plan`]). Generators start exact, with 0; copies keep what the original has.
    #[must_use]
    pub fn with_budget(self, budget: f64) -> Self {
        Self { budget, ..self }
    }

    /// The model file at `path`.
    pub fn open(path: &Path, device: &Device) -> Result<Self> {
        Self::from_bytes(path, &file::read_bytes(path)?, device)
    }

    /// The model in `bytes`; `name` stands for it in messages.
    pub fn from_bytes(name: &Path, bytes: &[u8], device: &Device) -> Result<Self> {
        let (header, tensors) = file::read_model(name, bytes)?;
        let generator = Self::from_tensors(&header.config, tensors, device).map_err(|error| match error {
            Error::Shape { .. } | Error::Config { .. } => Error::malformed(name, error),
            other => other,
        })?;
        Ok(Self { header: Some(header), ..generator })
    }

    /// The generator of `config` with these weights.
    pub fn from_tensors(config: &GeneratorConfig, tensors: Tensors, device: &Device) -> Result<Self> {
        let parameters = Parameters::loaded(tensors.into_iter().collect(), DType::F32, device);
        Self::new(config, &parameters)
    }

    /// A generator with weights of its own: changing one leaves the other as it is.
    pub fn duplicate(&self) -> Result<Self> {
        let copy = Self::from_tensors(&self.config, self.parameters.snapshot()?, &self.parameters.device())?;
        Ok(Self { header: self.header.clone(), budget: self.budget, ..copy })
    }

    /// The same weights with another upsampler: none, or a fresh one drawn from `seed`.
    pub fn with_upsampler(&self, upsampler: Option<&crate::config::UpsamplerConfig>, seed: u64) -> Result<Self> {
        let config = GeneratorConfig { upsampler: None, ..self.config.clone() };
        let bare = Self::from_tensors(&config, self.parameters.snapshot()?, &self.parameters.device())?;
        let Some(upsampler) = upsampler else { return Ok(bare) };
        let fresh = Parameters::fresh(seed, DType::F32, &self.parameters.device());
        Upsampler::new(upsampler, config.field.width, config.field.style_dim, &fresh.within("upsampler"))?;
        let mut tensors = bare.parameters.snapshot()?;
        tensors.extend(fresh.snapshot()?);
        let config = GeneratorConfig { upsampler: Some(upsampler.clone()), ..config };
        Self::from_tensors(&config, tensors, &self.parameters.device())
    }

    /// The same weights with portraits drawn from another population: of mean `[18 D]` and components `[K, 18 D]` (see
    /// [`Population`]), or none.
    pub fn with_population(&self, population: Option<(&Tensor, &Tensor)>) -> Result<Self> {
        let under = format!("{STATISTICS}.population.");
        let mut tensors = self.parameters.snapshot()?;
        tensors.retain(|name, _| !name.starts_with(&under));
        let mut config = GeneratorConfig { population: 0, ..self.config.clone() };
        if let Some((mean, components)) = population {
            config.population = components.dim(0)?;
            tensors.insert(format!("{under}mean"), mean.clone());
            tensors.insert(format!("{under}components"), components.clone());
        }
        Self::from_tensors(&config, tensors, &self.parameters.device())
    }

    /// Writes a model file and returns its header.
    pub fn save(&self, path: &Path, preset: &str, provenance: &str) -> Result<ModelHeader> {
        let header = ModelHeader {
            version: 1,
            config: self.config.clone(),
            preset: preset.to_owned(),
            provenance: provenance.to_owned(),
            hash: String::new(),
        };
        file::write_model(path, &self.parameters.snapshot()?, &header)
    }

    /// What the generator is.
    pub fn config(&self) -> &GeneratorConfig {
        &self.config
    }

    /// All weights; those under [`STATISTICS`] are not for training.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The field.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The upsampler, if there is one.
    pub fn upsampler(&self) -> Option<&Upsampler> {
        self.upsampler.as_ref()
    }

    /// What the model's file says of it; none for a generator that was never a file.
    pub fn header(&self) -> Option<&ModelHeader> {
        self.header.as_ref()
    }

    /// The hash portraits name their model by.
    pub fn hash(&self) -> Result<String> {
        match &self.header {
            Some(header) => Ok(header.hash.clone()),
            None => file::hash(&self.parameters.snapshot()?),
        }
    }

    /// Where the weights are.
    pub fn device(&self) -> Device {
        self.parameters.device()
    }

    /// z `[B, D]` to w `[B, D]`. z is in units of the model's own spread (see [`Self::spread`]).
    pub fn map(&self, z: &Tensor) -> Result<Tensor> {
        self.mapping.forward(z)
    }

    /// The mean w, `[D]`.
    pub fn mean_w(&self) -> &Tensor {
        &self.w_mean
    }

    /// The principal components that portraits are drawn from, if the model has them.
    pub fn population(&self) -> Option<&Population> {
        self.population.as_ref()
    }

    /// Length of the noise behind a portrait: a population's size, else `style_dim`.
    pub fn noise_dim(&self) -> usize {
        self.population.as_ref().map_or(self.config.field.style_dim, Population::size)
    }

    /// Codes `[B, 9, 2, D]` of portraits from standard normals `[B, noise_dim]`. Differentiable.
    pub fn codes_of(&self, noise: &Tensor) -> Result<Tensor> {
        match &self.population {
            Some(population) => population.codes(noise),
            None => codes::broadcast(&self.map(&self.spread(noise)?)?),
        }
    }

    /// Standard normals `[B, D]` as z of this model's own mean and spread.
    pub fn spread(&self, noise: &Tensor) -> Result<Tensor> {
        let (mean, deviation) = &self.z_statistics;
        Ok(noise.broadcast_mul(deviation)?.broadcast_add(mean)?)
    }

    /// Codes `[1, 9, 2, D]` of the random portrait `seed`, truncated by `psi` towards the mean (1 leaves them).
    pub fn codes_from_seed(&self, seed: u64, psi: f64) -> Result<Tensor> {
        let noise = Stream::new(seed, &[0x7a]).normal_tensor(&[1, self.noise_dim()], &self.device())?;
        let codes = self.codes_of(&noise)?;
        codes::truncate(&codes, &self.mean_codes()?.squeeze(0)?, psi)
    }

    /// The mean portrait's codes, `[1, 9, 2, D]`.
    pub fn mean_codes(&self) -> Result<Tensor> {
        match &self.population {
            Some(population) => population.mean(),
            None => codes::broadcast(&self.w_mean.unsqueeze(0)?),
        }
    }

    /// Takes the spread of z from the codes `[M, D]` of a training set, and measures the mean w.
    pub fn measure(&self, training_codes: Option<&Tensor>) -> Result<()> {
        let statistics: std::collections::BTreeMap<String, _> =
            self.parameters.within(STATISTICS).variables().into_iter().collect();
        let set = |name: &str, value: &Tensor| match statistics.get(&format!("{STATISTICS}.{name}")) {
            Some(variable) => Ok(variable.set(&value.detach())?),
            None => Err(Error::shape(name, "a statistic", &[])),
        };
        if let Some(z) = training_codes {
            let mean = z.mean(0)?;
            let variance = z.broadcast_sub(&mean)?.sqr()?.mean(0)?;
            set("z_mean", &mean)?;
            set("z_deviation", &variance.sqrt()?)?;
        }
        let noise =
            Stream::new(0, &[0x6d65]).normal_tensor(&[MEAN_DRAWS, self.config.field.style_dim], &self.device())?;
        let w = self.map(&self.spread(&noise)?)?;
        set("w_mean", &w.mean(0)?)
    }

    /// Settings a render for the upsampler needs: its input resolution, features, and normals if it reads them; and the
    /// generator's budget.
    pub fn render_settings(&self) -> RenderSettings {
        let sampling = match self.config.field.background {
            Background::FarPlane => Sampling::behind_the_surface(self.config.samples),
            Background::Field => Sampling::closed(self.config.samples),
        };
        RenderSettings {
            resolution: self.render_resolution(),
            sampling,
            features: self.upsampler.is_some(),
            normals: self.config.upsampler.as_ref().is_some_and(|upsampler| upsampler.normal_input),
            budget: self.budget,
            ..RenderSettings::default()
        }
    }

    /// Width and height of renders, pixels.
    pub fn render_resolution(&self) -> usize {
        self.config.upsampler.as_ref().map_or(FIELD_RESOLUTION, |upsampler| upsampler.input_resolution)
    }

    /// Width and height of finished pictures, pixels.
    pub fn output_resolution(&self) -> usize {
        self.config.upsampler.as_ref().map_or(FIELD_RESOLUTION, |upsampler| upsampler.output_resolution)
    }

    /// Renders of the portraits with `codes` `[B, 9, 2, D]` from `cameras` `[B, 6]`.
    pub fn render(&self, codes: &Tensor, cameras: &Tensor, settings: &RenderSettings) -> Result<Frame> {
        render_frame(&self.field.portraits(codes)?, cameras, settings)
    }

    /// Lifts a render (or a crop of one) to the output resolution; without an upsampler the render is the picture.
    /// `global` drives an upsampler of one global code; without it the mean of the texture rows does.
    pub fn upsample(&self, frame: &Frame, codes: &Tensor, global: Option<&Tensor>) -> Result<UpsamplerOutput> {
        self.upsample_with(frame, codes, global, Noise::Stored)
    }

    /// As [`Self::upsample`], with other noise than the model's own.
    pub fn upsample_with(
        &self,
        frame: &Frame,
        codes: &Tensor,
        global: Option<&Tensor>,
        noise: Noise<'_>,
    ) -> Result<UpsamplerOutput> {
        let Some(upsampler) = &self.upsampler else {
            return Ok(UpsamplerOutput { rgb: frame.colour.clone(), masks: frame.masks.clone() });
        };
        upsampler.forward(&Self::upsampler_input(frame)?, &self.upsampler_style(codes, global)?, noise)
    }

    /// What of a render the upsampler reads.
    pub fn upsampler_input(frame: &Frame) -> Result<UpsamplerInput> {
        let features =
            frame.features.clone().ok_or_else(|| Error::config("features", "the upsampler needs them rendered"))?;
        let (colour, masks, normal) = (frame.colour.clone(), frame.masks.clone(), frame.normal.clone());
        Ok(UpsamplerInput { colour, masks, features, normal })
    }

    /// What modulates the upsampler: the codes of all regions, or one code per portrait.
    pub fn upsampler_style(&self, codes: &Tensor, global: Option<&Tensor>) -> Result<Tensor> {
        let style = self.config.upsampler.as_ref().map_or(UpsamplerStyle::PerRegion, |config| config.style);
        Ok(match (style, global) {
            (UpsamplerStyle::PerRegion, _) => codes.clone(),
            (UpsamplerStyle::Global, Some(global)) => global.clone(),
            (UpsamplerStyle::Global, None) => codes.narrow(2, 1, 1)?.squeeze(2)?.mean(1)?,
        })
    }

    /// Finished pictures of the portraits with `codes` `[B, 9, 2, D]` from `cameras` `[B, 6]`.
    pub fn picture(&self, codes: &Tensor, cameras: &Tensor, settings: &RenderSettings) -> Result<Picture> {
        let frame = self.render(codes, cameras, settings)?;
        let UpsamplerOutput { rgb, masks } = self.upsample(&frame, codes, None)?;
        Ok(Picture { rgb, masks, frame })
    }
}
