//! What a model is: every choice that changes its weights' shapes or their meaning. Saved in every model file.
//!
//! Each choice has the paper's form and ours (design: "The field: the paper's form, and ours"); [`FieldConfig::paper`]
//! and [`FieldConfig::ours`] set them together. Training and rendering settings live where they are used.

use serde::{Deserialize, Serialize};

pub use cnerf_kernels::{FILM_LAYERS, SHAPE_LAYERS, SdfHead, TEXTURE_LAYERS};

use crate::error::{Error, Result};

/// Which networks make up the field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Composition {
    /// The paper: a local generator for every region, each driven by the region's own codes.
    #[default]
    Regions,
    /// One network for the whole head with a mask output for every region, driven by one shape and one texture code,
    /// those of the face, as in FENeRF (Sun et al. 2022): a baseline that no region can be edited in.
    Single,
}

/// How local residuals join the global distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Residual {
    /// The paper: d = d0 + Σ Δd_i.
    Sum,
    /// d = d0 + Σ m_i Δd_i with the fused masks: a region holds only its own geometry.
    Gated,
}

/// How raw masks become fusion weights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fusion {
    /// The paper: raw masks, not limited in range.
    Raw,
    /// Softmax over the regions of the volume of `sharpness` x raw mask: no gaps, no overlaps.
    Softmax {
        /// Factor on the raw masks; the recipe uses 4.
        sharpness: f64,
    },
}

/// Where the background region lives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// The paper: a region of the volume like any other; the last sample closes the ray.
    Field,
    /// Evaluated once per ray on the far plane and weighted by the transmittance that is left.
    FarPlane,
}

/// What the networks' distance output means (the paper's ablation).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DensityKind {
    /// d = d0 + residuals; σ = sigmoid(-d / α) / α.
    ResidualSdf,
    /// d = residuals alone; σ as above.
    Sdf,
    /// The summed output is the density itself, through a softplus.
    Density,
}

/// The global distance d0 the residuals are added to.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InitialDistance {
    /// |x| - radius, world units.
    Sphere {
        /// World units; a quarter of far - near in both the paper's code and ours.
        radius: f64,
    },
    /// The authors' separate frozen network, driven by the background region's codes. Only in imported models.
    Network,
}

/// FiLM: γ = gamma_gain (A w + a) + gamma_offset, β = beta_gain (B w + b), as in sin(γ (W x + b) + β).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FilmConfig {
    /// Authors 15; recipe 7.5.
    pub gamma_gain: f64,
    /// Authors 30; recipe 15.
    pub gamma_offset: f64,
    /// 0.25 in both.
    pub beta_gain: f64,
}

/// The compositional field.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldConfig {
    /// Which networks make it up.
    #[serde(default)]
    pub composition: Composition,
    /// Length of one code row. Paper 256; recipe 128.
    pub style_dim: usize,
    /// Width of every local generator's layers. Paper 128; recipe 48; ours 64.
    pub width: usize,
    /// FiLM's affine constants.
    pub film: FilmConfig,
    /// Branch of the residual distance head.
    pub sdf_head: SdfHead,
    /// How residuals join.
    pub residual: Residual,
    /// How masks fuse.
    pub fusion: Fusion,
    /// Where the background lives.
    pub background: Background,
    /// Whether mask heads see the view direction (paper: yes; gated residuals forbid it).
    pub mask_view_input: bool,
    /// Whether feature heads, and so colours, see the view direction (paper: yes).
    pub feature_view_input: bool,
    /// What the distance output means.
    pub density: DensityKind,
    /// The global distance.
    pub initial_distance: InitialDistance,
    /// World units per unit of the residual head's output. Authors 1; ours 0.12, half the depth of the volume.
    pub residual_scale: f64,
    /// Start of the learnt α, world units (paper: 0.1).
    pub alpha_initial: f64,
}

impl FieldConfig {
    /// The paper's form at the authors' sizes.
    pub fn paper() -> Self {
        Self {
            composition: Composition::Regions,
            style_dim: 256,
            width: 128,
            film: FilmConfig { gamma_gain: 15.0, gamma_offset: 30.0, beta_gain: 0.25 },
            sdf_head: SdfHead::Shape,
            residual: Residual::Sum,
            fusion: Fusion::Raw,
            background: Background::Field,
            mask_view_input: true,
            feature_view_input: true,
            density: DensityKind::ResidualSdf,
            initial_distance: InitialDistance::Sphere { radius: 0.06 },
            residual_scale: 1.0,
            alpha_initial: 0.1,
        }
    }

    /// Our form, CPU-sized.
    pub fn ours() -> Self {
        Self {
            style_dim: 128,
            width: 64,
            film: FilmConfig { gamma_gain: 7.5, gamma_offset: 15.0, beta_gain: 0.25 },
            residual: Residual::Gated,
            fusion: Fusion::Softmax { sharpness: 4.0 },
            background: Background::FarPlane,
            mask_view_input: false,
            feature_view_input: false,
            residual_scale: 0.12,
            alpha_initial: 0.012,
            ..Self::paper()
        }
    }

    /// Refuses combinations that contradict each other.
    pub fn validate(&self) -> Result<()> {
        let refuse = |option: &str, reason: &str| Err(Error::config(format!("field.{option}"), reason));
        if self.style_dim == 0 || self.width == 0 {
            return refuse("width", "width and style_dim must be at least 1");
        }
        if self.residual == Residual::Gated && self.mask_view_input {
            return refuse(
                "mask_view_input",
                "gated residuals need masks that do not depend on the view; set it to false",
            );
        }
        let one_distance = self.residual == Residual::Gated && matches!(self.fusion, Fusion::Softmax { .. });
        if self.composition == Composition::Single && !one_distance {
            return refuse(
                "composition",
                "a single network has one distance and one colour; only gated residuals and softmax masks leave them as \
                 they are",
            );
        }
        if !(self.alpha_initial > 0.0 && self.alpha_initial.is_finite()) {
            return refuse("alpha_initial", "must be a positive number");
        }
        if let Fusion::Softmax { sharpness } = self.fusion
            && !(sharpness > 0.0 && sharpness.is_finite())
        {
            return refuse("fusion.sharpness", "must be a positive number");
        }
        Ok(())
    }
}

/// What drives the upsampler's modulated convolutions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpsamplerStyle {
    /// The paper: one global code.
    Global,
    /// Each pixel by Σ mask_k · A w_k with the texture rows: edits reach the fine detail of their region alone.
    PerRegion,
}

/// The upsampler's architecture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpsamplerKind {
    /// The paper: StyleGAN2 blocks with an image and a mask branch, noise buffers and FIR upsampling.
    StyleGan2,
    /// The recipe: modulated residual blocks at the render's and the output's resolution, added to the bilinear colour.
    Residual,
}

/// The 2D generator that lifts renders to the output resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpsamplerConfig {
    /// Architecture.
    pub kind: UpsamplerKind,
    /// What modulates it.
    pub style: UpsamplerStyle,
    /// Width and height of the render it reads, pixels.
    pub input_resolution: usize,
    /// Width and height of its output, pixels; a power of two times the input's.
    pub output_resolution: usize,
    /// Channels at resolutions from the input's upward. Authors: 512 at 64, 256 at 128, 128 at 256, 64 at 512.
    pub channels: Vec<usize>,
    /// Fully connected layers before the style (authors' decoder: 5, on PixelNorm); 0 uses codes as they are.
    pub style_layers: usize,
    /// Length of the style after those layers; authors 2 x style_dim.
    pub latent_dim: usize,
    /// Residual blocks at each resolution (`Residual` only; recipe 3 at 64, 2 at 128).
    pub blocks: Vec<usize>,
    /// Whether the render's normals are among its inputs (`Residual` only; recipe: yes).
    #[serde(default)]
    pub normal_input: bool,
}

impl UpsamplerConfig {
    /// The recipe's 64 → 128 network.
    pub fn ours(style_dim: usize) -> Self {
        Self {
            kind: UpsamplerKind::Residual,
            style: UpsamplerStyle::PerRegion,
            input_resolution: 64,
            output_resolution: 128,
            channels: vec![44, 28],
            style_layers: 0,
            latent_dim: style_dim,
            blocks: vec![3, 2],
            normal_input: true,
        }
    }

    /// The paper's 64 → 512 generator.
    pub fn paper(style_dim: usize) -> Self {
        Self {
            kind: UpsamplerKind::StyleGan2,
            style: UpsamplerStyle::Global,
            input_resolution: 64,
            output_resolution: 512,
            channels: vec![512, 256, 128, 64],
            style_layers: 5,
            latent_dim: 2 * style_dim,
            blocks: Vec::new(),
            normal_input: false,
        }
    }
}

/// A whole generator.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeneratorConfig {
    /// The field.
    pub field: FieldConfig,
    /// The upsampler; none while only the field is trained.
    pub upsampler: Option<UpsamplerConfig>,
    /// Standard deviation of the training cameras' azimuth and elevation, radians.
    pub camera_deviation_rad: [f64; 2],
    /// Samples per ray when nothing else is asked for.
    pub samples: usize,
    /// Principal components of training portraits' codes that portraits are drawn from; 0 draws noise through the
    /// mapping network (paper).
    #[serde(default)]
    pub population: usize,
}
