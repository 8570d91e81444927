//! The compositional field: nine local generators over one signed distance (paper, Compositional Neural Radiance
//! Field; the forms of the design's "The field: the paper's form, and ours").
//!
//! A [`Field`] holds weights. Codes turn it into a [`PortraitField`], which answers for points of space: the local
//! generators' raw outputs come from the kernels, this file fuses them.

use candle_core::{DType, Tensor};

use crate::{
    camera::INPUT_SCALE,
    codes,
    config::{
        Background, Composition, DensityKind, FILM_LAYERS, FieldConfig, FilmConfig, Fusion, InitialDistance, Residual,
        SHAPE_LAYERS, SdfHead, TEXTURE_LAYERS,
    },
    error::{Error, Result},
    kernels::{HeadShape, Outputs, autograd, parts::Parts},
    parameters::{Init, Parameters},
    region::{REGION_COUNT, Region, RegionSet},
    render::{
        BackgroundEvaluation, Evaluation, RadianceField, norm,
        plan::{LocalFeatures, LocalField, LocalInitial, LocalWeights},
    },
};

/// FiLM-SIREN layers and residual heads of `k` local generators, weights stacked over them.
#[derive(Clone, Debug)]
struct Generators {
    /// Per layer `[k, W, 3 or W]` and `[k, W]`.
    layers: Vec<(Tensor, Tensor)>,
    /// `[k, 5, 2 W, D]`, `[k, 5, 2 W]`; rows of γ first.
    film: (Tensor, Tensor),
    /// `[k, 1, W]`, `[k, 1]`.
    residual: (Tensor, Tensor),
}

impl Generators {
    /// Starts as the recipe's: first layer ±1/3, hidden layers and heads ±√(6 / W) / 25, FiLM with a quarter of unit
    /// variance.
    fn new(count: usize, config: &FieldConfig, parameters: &Parameters) -> Result<Self> {
        let (width, style_dim) = (config.width, config.style_dim);
        let layers = (0..FILM_LAYERS)
            .map(|layer| {
                let (inputs, bound) = if layer == 0 { (3, 1.0 / 3.0) } else { (width, hidden_bound(width)) };
                let number = layer + 1;
                let weight =
                    parameters.get(&format!("weight{number}"), &[count, width, inputs], Init::Uniform(bound))?;
                let bound = 0.5 / (width as f64).sqrt();
                Ok((weight, parameters.get(&format!("bias{number}"), &[count, width], Init::Uniform(bound))?))
            })
            .collect::<Result<_>>()?;
        let deviation = 0.25 / (style_dim as f64).sqrt();
        let film = &parameters.within("film");
        let residual = &parameters.within("residual");
        Ok(Self {
            layers,
            film: (
                film.get("weight", &[count, FILM_LAYERS, 2 * width, style_dim], Init::Normal(deviation))?,
                film.get("bias", &[count, FILM_LAYERS, 2 * width], Init::Constant(0.0))?,
            ),
            residual: (
                residual.get("weight", &[count, 1, width], Init::Uniform(hidden_bound(width)))?,
                residual.get("bias", &[count, 1], Init::Constant(0.0))?,
            ),
        })
    }

    /// One generator's weights as those of every region: views, not copies, so that there is one set to learn.
    fn for_all_regions(self) -> Result<Self> {
        let pair =
            |(weight, bias): (Tensor, Tensor)| Ok::<_, Error>((for_all_regions(weight)?, for_all_regions(bias)?));
        Ok(Self {
            layers: self.layers.into_iter().map(pair).collect::<Result<_>>()?,
            film: pair(self.film)?,
            residual: pair(self.residual)?,
        })
    }

    /// γ and β of every layer, `[B, k, 5, 2, W]`, from codes `[B, k, 2, D]`: shape rows drive the first three
    /// layers, texture rows the last two.
    fn film(&self, codes: &Tensor, config: &FilmConfig) -> Result<Tensor> {
        let (batch, count, _, style_dim) = codes.dims4()?;
        let (weight, bias) = &self.film;
        let width = weight.dim(2)? / 2;
        let driven = |row: usize, first: usize, layers: usize| -> Result<Tensor> {
            let code = codes.narrow(2, row, 1)?.squeeze(2)?.transpose(0, 1)?.contiguous()?; // [k, B, D]
            let weight = weight.narrow(1, first, layers)?.reshape((count, layers * 2 * width, style_dim))?;
            let bias = bias.narrow(1, first, layers)?.reshape((count, 1, layers * 2 * width))?;
            let linear = code.matmul(&weight.transpose(1, 2)?.contiguous()?)?.broadcast_add(&bias)?;
            Ok(linear.reshape((count, batch, layers, 2, width))?)
        };
        let linear = Tensor::cat(&[driven(0, 0, SHAPE_LAYERS)?, driven(1, SHAPE_LAYERS, TEXTURE_LAYERS)?], 2)?;
        let constants = |gamma: f64, beta: f64| -> Result<Tensor> {
            Ok(Tensor::new(&[gamma, beta], codes.device())?.to_dtype(codes.dtype())?.reshape((1, 1, 1, 2, 1))?)
        };
        let gain = constants(config.gamma_gain, config.beta_gain)?;
        let offset = constants(config.gamma_offset, 0.0)?;
        Ok(linear.broadcast_mul(&gain)?.broadcast_add(&offset)?.transpose(0, 1)?.contiguous()?)
    }

    /// All weights of each generator in a row, `[k, P]`, in the order of [`HeadShape::layout`].
    fn pack(&self, mask: (&Tensor, &Tensor), colour: (&Tensor, &Tensor)) -> Result<Tensor> {
        let layers = self.layers.iter().map(|(weight, bias)| (weight, bias));
        let heads = [mask, (&self.residual.0, &self.residual.1), colour];
        let parts = layers
            .chain(heads)
            .flat_map(|(weight, bias)| [weight, bias])
            .map(|part| part.flatten_from(1))
            .collect::<candle_core::Result<Vec<_>>>()?;
        Ok(Tensor::cat(&parts, 1)?)
    }
}

/// `[1, …]` as `[9, …]`.
fn for_all_regions(tensor: Tensor) -> Result<Tensor> {
    let mut shape = tensor.dims().to_vec();
    if let Some(first) = shape.first_mut() {
        *first = REGION_COUNT;
    }
    Ok(tensor.broadcast_as(shape)?)
}

fn hidden_bound(width: usize) -> f64 {
    (6.0 / width as f64).sqrt() / 25.0
}

/// The field's weights.
#[derive(Clone, Debug)]
pub struct Field {
    config: FieldConfig,
    generators: Generators,
    /// `[9, 1, W (+ 3)]`, `[9, 1]`.
    mask: (Tensor, Tensor),
    /// `[9, F, W (+ 3)]`, `[9, F]` with F = W.
    feature: (Tensor, Tensor),
    /// `[9, 3, F]`, `[9, 3]`.
    colour: (Tensor, Tensor),
    /// ln α, α in world units: `[1]`.
    log_alpha: Tensor,
    /// The authors' initial network.
    initial: Option<Generators>,
}

impl Field {
    /// Weights by name, stacked over the regions: `weight1..5`, `bias1..5`, `film.*`, `mask.*`, `residual.*`,
    /// `feature.*`, `colour.*`, `log_alpha`, and `initial.*` for an imported initial network, which is frozen.
    ///
    /// The feature map starts as the identity. The colour seen is (W_c W_f) h: so it starts as a direct head W_c h
    /// does, and as W_f is about 1 and W_c small, Adam moves it at the rate of a direct head too (the recipe's is
    /// one), where the authors' quarter-variance start of W_f would make it four times slower.
    pub fn new(config: &FieldConfig, parameters: &Parameters) -> Result<Self> {
        config.validate()?;
        let width = config.width;
        let head = |name: &str, (count, outputs): (usize, usize), inputs: usize, weight: Init, bias: f64| {
            let parameters = parameters.within(name);
            let weight = parameters.get("weight", &[count, outputs, inputs], weight)?;
            Ok::<_, Error>((weight, parameters.get("bias", &[count, outputs], Init::Constant(bias))?))
        };
        let uniform = Init::Uniform(hidden_bound(width));
        let seen = |sees: bool| if sees { width + 3 } else { width };
        let initial = match config.initial_distance {
            InitialDistance::Network => Some(Generators::new(1, config, &parameters.within("initial"))?),
            InitialDistance::Sphere { .. } => None,
        };
        let networks = match config.composition {
            Composition::Regions => REGION_COUNT,
            Composition::Single => 1,
        };
        let mut generators = Generators::new(networks, config, parameters)?;
        let mut feature = head("feature", (networks, width), seen(config.feature_view_input), Init::Identity, 0.0)?;
        let mut colour = head("colour", (networks, 3), width, uniform, 0.0)?;
        if config.composition == Composition::Single {
            generators = generators.for_all_regions()?;
            for tensor in [&mut feature.0, &mut feature.1, &mut colour.0, &mut colour.1] {
                *tensor = for_all_regions(tensor.clone())?;
            }
        }
        Ok(Self {
            config: config.clone(),
            generators,
            mask: head("mask", (REGION_COUNT, 1), seen(config.mask_view_input), uniform, 1.0 / 8.0)?,
            feature,
            colour,
            log_alpha: parameters.get("log_alpha", &[1], Init::Constant(config.alpha_initial.ln()))?,
            initial,
        })
    }

    /// What the field is.
    pub fn config(&self) -> &FieldConfig {
        &self.config
    }

    /// α, world units, positive: `[1]`.
    pub fn alpha(&self) -> Result<Tensor> {
        Ok(bounded(&self.log_alpha)?.exp()?)
    }

    /// γ and β of every region and layer, `[B, 9, 5, 2, W]`, from codes `[B, 9, 2, D]`.
    pub fn film(&self, codes: &Tensor) -> Result<Tensor> {
        let (_, style_dim) = codes::dimensions(codes)?;
        if style_dim != self.config.style_dim {
            return Err(Error::shape("codes", format!("[B, 9, 2, {}]", self.config.style_dim), codes.dims()));
        }
        match self.config.composition {
            Composition::Regions => self.generators.film(codes, &self.config.film),
            Composition::Single => {
                let code = codes.narrow(1, Region::Face.index(), 1)?.broadcast_as(codes.shape())?.contiguous()?;
                self.generators.film(&code, &self.config.film)
            }
        }
    }

    /// The field of the portraits with these codes `[B, 9, 2, D]`. Differentiable in codes and weights.
    pub fn portraits(&self, codes: &Tensor) -> Result<PortraitField> {
        let film = self.film(codes)?;
        // Features are linear, so the colour head on top of them is one linear map of the last hidden layer.
        let colour = self.colour.0.contiguous()?;
        let colour_weight = colour.matmul(&self.feature.0.contiguous()?)?;
        let colour_bias = (colour.matmul(&self.feature.1.unsqueeze(2)?.contiguous()?)?.squeeze(2)? + &self.colour.1)?;
        let weights = self.generators.pack((&self.mask.0, &self.mask.1), (&colour_weight, &colour_bias))?;
        let regions = |first: usize, count: usize| -> Result<Kernel> {
            Ok(Kernel {
                shape: self.head_shape(),
                weights: weights.narrow(0, first, count)?.contiguous()?,
                film: film.narrow(1, first, count)?.contiguous()?,
            })
        };
        let (volume, background) = match self.config.background {
            Background::Field => (regions(0, REGION_COUNT)?, None),
            Background::FarPlane => (regions(1, REGION_COUNT - 1)?, Some(regions(0, 1)?)),
        };
        let initial = match &self.initial {
            Some(network) => Some(self.initial_kernel(network, codes)?),
            None => None,
        };
        Ok(PortraitField {
            config: self.config.clone(),
            volume,
            background,
            initial,
            log_alpha: self.log_alpha.clone(),
            feature: self.feature.clone(),
        })
    }

    fn head_shape(&self) -> HeadShape {
        HeadShape {
            width: self.config.width,
            sdf_head: self.config.sdf_head,
            mask_view: self.config.mask_view_input,
            colour_view: self.config.feature_view_input,
        }
    }

    /// The authors' initial network is one more local generator of which only the distance is used, on the
    /// background's codes.
    fn initial_kernel(&self, network: &Generators, codes: &Tensor) -> Result<Kernel> {
        let width = self.config.width;
        let zeros = |shape: &[usize]| Tensor::zeros(shape, codes.dtype(), codes.device());
        let (mask, colour) = ((zeros(&[1, 1, width])?, zeros(&[1, 1])?), (zeros(&[1, 3, width])?, zeros(&[1, 3])?));
        let weights = network.pack((&mask.0, &mask.1), (&colour.0, &colour.1))?.detach();
        let frozen = Generators { film: (network.film.0.detach(), network.film.1.detach()), ..network.clone() };
        Ok(Kernel {
            shape: HeadShape { width, sdf_head: SdfHead::Texture, mask_view: false, colour_view: false },
            weights,
            film: frozen.film(&codes.narrow(1, 0, 1)?, &self.config.film)?,
        })
    }
}

/// α is kept between 1e-5 and 10 world units: below, no sample ever meets the surface; above, there is none.
fn bounded(log_alpha: &Tensor) -> Result<Tensor> {
    Ok(log_alpha.maximum(1e-5f64.ln())?.minimum(10f64.ln())?)
}

/// Local generators ready for the kernels.
#[derive(Clone, Debug)]
struct Kernel {
    shape: HeadShape,
    weights: Tensor,
    film: Tensor,
}

impl Kernel {
    /// `[B, k, C, N]` at world `points` `[B, N, 3]`.
    fn evaluate(&self, points: &Tensor, view_directions: Option<&Tensor>, outputs: Outputs) -> Result<Parts> {
        let inputs = (points * INPUT_SCALE)?;
        let inputs = match (self.shape.point_columns(), view_directions) {
            (6, Some(directions)) => Tensor::cat(&[&inputs, directions], 2)?,
            (6, None) => Tensor::cat(&[&inputs, &inputs.zeros_like()?], 2)?,
            _ => inputs,
        };
        Ok(autograd::evaluate_in_parts(&inputs, &self.weights, &self.film, self.shape, outputs)?)
    }

    fn local(&self, portrait: usize) -> Result<LocalWeights> {
        let values = |tensor: &Tensor| -> Result<Vec<f32>> { Ok(tensor.flatten_all()?.to_vec1()?) };
        let film = values(&self.film.narrow(0, portrait, 1)?)?;
        Ok(LocalWeights { shape: self.shape, weights: values(&self.weights)?, film })
    }

    fn detached(&self) -> Self {
        Self { shape: self.shape, weights: self.weights.detach(), film: self.film.detach() }
    }
}

/// A [`Field`] with the codes of B portraits.
#[derive(Clone, Debug)]
pub struct PortraitField {
    config: FieldConfig,
    volume: Kernel,
    background: Option<Kernel>,
    initial: Option<Kernel>,
    log_alpha: Tensor,
    feature: (Tensor, Tensor),
}

impl PortraitField {
    fn local_features(&self) -> Result<LocalFeatures> {
        let (weight, bias) = &self.feature;
        let (_, count, columns) = weight.dims3()?;
        let values = |tensor: &Tensor| -> Result<Vec<f32>> { Ok(tensor.flatten_all()?.to_vec1()?) };
        let (weight, bias) = (values(weight)?, values(bias)?);
        Ok(LocalFeatures { count, columns, weight, bias, sees_view: self.config.feature_view_input })
    }

    /// Without a gradient from the initial network's distance to the codes, as the authors train and invert.
    #[must_use]
    pub fn with_frozen_initial_distance(mut self) -> Self {
        self.initial = self.initial.map(|initial| initial.detached());
        self
    }

    /// d0 `[B, N]` and, if asked for, ∇d0 `[B, 3, N]`, world units; none if the distance is residuals alone.
    fn initial_distance(&self, points: &Tensor, gradient: bool) -> Result<Option<(Tensor, Option<Tensor>)>> {
        if self.config.density != DensityKind::ResidualSdf {
            return Ok(None);
        }
        if let Some(network) = &self.initial {
            let rows = network.shape.rows(Outputs { gradient, ..Outputs::default() });
            let raw =
                network.evaluate(points, None, Outputs { gradient, ..Outputs::default() })?.tensor()?.squeeze(1)?;
            let slope = match rows.residual_gradient {
                Some(range) => Some((raw.narrow(1, range.start, range.len())? * INPUT_SCALE)?),
                None => None,
            };
            return Ok(Some((raw.narrow(1, rows.residual, 1)?.squeeze(1)?, slope)));
        }
        let InitialDistance::Sphere { radius } = self.config.initial_distance else {
            return Err(Error::config("field.initial_distance", "this model has no initial network; convert it again"));
        };
        let length = norm(points)?;
        let slope = if gradient {
            Some(points.broadcast_div(&length.unsqueeze(2)?)?.transpose(1, 2)?.contiguous()?)
        } else {
            None
        };
        Ok(Some(((length - radius)?, slope)))
    }

    /// Fusion weights `[B, k, N]` from the mask heads' raw values.
    fn fuse(&self, raw: &Tensor) -> Result<Tensor> {
        match self.config.fusion {
            Fusion::Raw => Ok(raw.clone()),
            Fusion::Softmax { sharpness } => {
                let scaled = (raw * sharpness)?;
                // The shift cancels, so it needs no gradient.
                let shifted = scaled.broadcast_sub(&scaled.detach().max_keepdim(1)?)?.exp()?;
                Ok(shifted.broadcast_div(&shifted.sum_keepdim(1)?)?)
            }
        }
    }

    /// Σ over regions of what the residuals add to ∇d, `[B, 3, N]`, from the slopes of raw masks and residuals in
    /// world units, `[B, k, 3, N]`. Gated, d = d0 + Σ m_i Δd_i, so ∇d has Σ m_i ∇Δd_i + Σ Δd_i ∇m_i, where for a
    /// softmax of sharpness s: Σ Δd_i ∇m_i = s Σ m_i (Δd_i - Σ_j m_j Δd_j) ∇raw_i.
    fn residual_gradient(
        &self,
        masks: &Tensor,
        residuals: &Tensor,
        mask_slopes: &Tensor,
        residual_slopes: &Tensor,
    ) -> Result<Tensor> {
        if self.config.residual == Residual::Sum {
            return Ok(residual_slopes.sum(1)?);
        }
        let own = residual_slopes.broadcast_mul(&masks.unsqueeze(2)?)?.sum(1)?;
        let share = match self.config.fusion {
            Fusion::Raw => residuals.clone(),
            Fusion::Softmax { sharpness } => {
                let mean = (masks * residuals)?.sum_keepdim(1)?;
                ((masks * residuals.broadcast_sub(&mean)?)? * sharpness)?
            }
        };
        Ok((own + mask_slopes.broadcast_mul(&share.unsqueeze(2)?)?.sum(1)?)?)
    }
}

impl RadianceField for PortraitField {
    fn volume_regions(&self) -> RegionSet {
        match self.config.background {
            Background::Field => RegionSet::ALL,
            Background::FarPlane => RegionSet::FOREGROUND,
        }
    }

    fn sees_view(&self) -> bool {
        self.config.mask_view_input || self.config.feature_view_input
    }

    fn evaluate(&self, points: &Tensor, view_directions: Option<&Tensor>, outputs: Outputs) -> Result<Evaluation> {
        let rows = self.volume.shape.rows(outputs);
        let raw = self.volume.evaluate(points, view_directions, outputs)?;
        let one = |row: usize| -> Result<Tensor> { Ok(raw.rows(row..row + 1)?.tensor()?.squeeze(2)?) };
        let cut = |rows: Option<std::ops::Range<usize>>| -> Result<Option<Tensor>> {
            rows.map(|rows| Ok(raw.rows(rows)?.tensor()?)).transpose()
        };
        let scale = self.config.residual_scale;
        let masks = self.fuse(&one(rows.mask)?)?;
        let residuals = (one(rows.residual)? * scale)?;
        let mut distance = match self.config.residual {
            Residual::Sum => residuals.sum(1)?,
            Residual::Gated => (&masks * &residuals)?.sum(1)?,
        };
        let mut gradient = match (cut(rows.mask_gradient)?, cut(rows.residual_gradient)?) {
            (Some(mask), Some(residual)) => {
                let residual = (residual * (scale * INPUT_SCALE))?;
                Some(self.residual_gradient(&masks, &residuals, &(mask * INPUT_SCALE)?, &residual)?)
            }
            _ => None,
        };
        if self.config.density == DensityKind::Density {
            // The heads' sum is a density, large inside: turned around, it reads like a distance.
            distance = distance.neg()?;
            gradient = gradient.map(|gradient| gradient.neg()).transpose()?;
        }
        if let Some((initial, slope)) = self.initial_distance(points, outputs.gradient)? {
            distance = (distance + initial)?;
            gradient = match (gradient, slope) {
                (Some(gradient), Some(slope)) => Some((gradient + slope)?),
                (gradient, _) => gradient,
            };
        }
        Ok(Evaluation {
            distance,
            masks,
            residuals,
            colours: cut(rows.colour)?,
            activations: rows.activations.map(|rows| raw.rows(rows)).transpose()?,
            gradient,
        })
    }

    /// sigmoid(-d / α) / α (paper), or for [`DensityKind::Density`] the softplus of the heads' sum per unit of their
    /// length.
    fn density(&self, distance: &Tensor) -> Result<Tensor> {
        if self.config.density == DensityKind::Density {
            let scale = self.config.residual_scale;
            let sum = (distance * (-1.0 / scale))?;
            let softplus = (sum.relu()? + (sum.abs()?.neg()?.exp()? + 1.0)?.log()?)?;
            return Ok((softplus / scale)?);
        }
        let inverse = bounded(&self.log_alpha)?.neg()?.exp()?;
        // Not a sigmoid, whose slope s (1 − s) cancels deep inside. Beyond 80 α the density is below 1e-33 / α.
        let outward = distance.broadcast_mul(&inverse)?.minimum(80.0)?.exp()?;
        Ok((outward + 1.0)?.recip()?.broadcast_mul(&inverse)?)
    }

    fn background(
        &self,
        points: &Tensor,
        view_directions: Option<&Tensor>,
        activations: bool,
    ) -> Result<Option<BackgroundEvaluation>> {
        let Some(kernel) = &self.background else { return Ok(None) };
        let outputs = Outputs { colour: true, activations, gradient: false };
        let rows = kernel.shape.rows(outputs);
        let raw = kernel.evaluate(points, view_directions, outputs)?.tensor()?.squeeze(1)?;
        let block = |range: Option<std::ops::Range<usize>>| -> Result<Option<Tensor>> {
            range.map(|range| Ok(raw.narrow(1, range.start, range.len())?)).transpose()
        };
        let colour = block(rows.colour)?.ok_or_else(|| Error::config("outputs", "the kernel gave no colour"))?;
        Ok(Some(BackgroundEvaluation { colour, activations: block(rows.activations)? }))
    }

    fn features(&self, activations: &Tensor, masks: &Tensor, view_directions: Option<&Tensor>) -> Result<Tensor> {
        let (batch, regions, width, rays) = activations.dims4()?;
        let (weight, bias) = &self.feature;
        let features = weight.dim(1)?;
        if (regions, width) != (REGION_COUNT, self.config.width) {
            return Err(Error::shape("activations", ["B", "9", "W", "R"], activations.dims()));
        }
        // All linear in [activations; view x masks; masks], so one matrix product over regions and channels does it.
        let mut parts = vec![activations.clone()];
        if self.config.feature_view_input {
            let directions = view_directions.ok_or_else(|| {
                Error::config("field.feature_view_input", "features of this model need view directions")
            })?;
            let directions = directions.transpose(1, 2)?.unsqueeze(1)?; // [B, 1, 3, R]
            parts.push(masks.unsqueeze(2)?.broadcast_mul(&directions)?);
        }
        parts.push(masks.unsqueeze(2)?);
        let inputs = Tensor::cat(&parts, 2)?;
        let weight = Tensor::cat(&[weight, &bias.unsqueeze(2)?], 2)?; // [9, F, W (+ 3) + 1]
        let columns = weight.dim(2)?;
        let weight = weight.transpose(0, 1)?.reshape((1, features, regions * columns))?;
        let weight = weight.broadcast_as((batch, features, regions * columns))?.contiguous()?;
        Ok(weight.matmul(&inputs.reshape((batch, regions * columns, rays))?)?)
    }

    fn local(&self, portrait: usize) -> Result<Option<LocalField>> {
        let plain = |kernel: &Kernel| kernel.weights.device().is_cpu() && kernel.weights.dtype() == DType::F32;
        if !plain(&self.volume) {
            return Ok(None);
        }
        Ok(Some(LocalField {
            volume: self.volume_regions(),
            generators: self.volume.local(portrait)?,
            background: self.background.as_ref().map(|kernel| kernel.local(portrait)).transpose()?,
            initial: match (self.config.density, &self.initial, self.config.initial_distance) {
                (DensityKind::Sdf | DensityKind::Density, _, _) => LocalInitial::None,
                (DensityKind::ResidualSdf, Some(network), _) => LocalInitial::Network(network.local(portrait)?),
                (DensityKind::ResidualSdf, None, InitialDistance::Sphere { radius }) => LocalInitial::Sphere { radius },
                (DensityKind::ResidualSdf, None, InitialDistance::Network) => return Ok(None),
            },
            fusion: self.config.fusion,
            residual: self.config.residual,
            residual_scale: self.config.residual_scale,
            density: self.config.density,
            inverse_alpha: bounded(&self.log_alpha)?.neg()?.exp()?.squeeze(0)?.to_scalar::<f32>()?,
            features: self.local_features()?,
        }))
    }

    fn detached(&self) -> Self {
        Self {
            config: self.config.clone(),
            volume: self.volume.detached(),
            background: self.background.as_ref().map(Kernel::detached),
            initial: self.initial.as_ref().map(Kernel::detached),
            log_alpha: self.log_alpha.detach(),
            feature: (self.feature.0.detach(), self.feature.1.detach()),
        }
    }
}

#[cfg(test)]
mod tests;
