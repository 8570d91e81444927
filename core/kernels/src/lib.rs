//! How the local generators are evaluated at points, with exact gradients.
//!
//! A local generator is five FiLM-SIREN layers with three heads (paper, "Local generators"):
//! h_l = sin(γ_l ∘ (W_l h_{l-1} + b_l) + β_l) with h_0 the point; the mask reads h_3, the residual distance h_3 or h_5
//! ([`SdfHead`]), the colour h_5. [`autograd::evaluate`] is the door: a differentiable candle function over whichever
//! [`RegionKernel`] the processor runs best; [`prepared`] the way in for renderers that leave most of the work out.
//! [`plain`] is the reference anybody can check, [`composed`] the same in candle operations for other devices, [`fused`]
//! the fast one; a [`Path`] says which of them is used.

use std::ops::Range;

use serde::{Deserialize, Serialize};

#[cfg(test)]
mod agreement;
mod error;
mod path;
#[cfg(test)]
mod random;

pub mod activation;
pub mod autograd;
pub mod composed;
pub mod conv;
pub mod fused;
pub mod parts;
pub mod peak;
pub mod plain;
pub mod prepared;
pub mod rays;
pub mod simd;

pub use error::{Error, Result};
pub use path::{KERNEL_VARIABLE, Path, selected};
pub use prepared::PreparedRegion;

/// Which branch of a local generator carries the residual distance head.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SdfHead {
    /// After the three shape layers: a texture code cannot move a surface.
    Shape,
    /// After the two texture layers, as in the authors' code.
    Texture,
}

/// Number of FiLM-SIREN layers driven by the shape code (paper).
pub const SHAPE_LAYERS: usize = 3;
/// Number of FiLM-SIREN layers driven by the texture code (paper).
pub const TEXTURE_LAYERS: usize = 2;
/// All FiLM-SIREN layers of a local generator.
pub const FILM_LAYERS: usize = SHAPE_LAYERS + TEXTURE_LAYERS;

/// What decides a local generator's weights: its width and what its heads read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HeadShape {
    /// Width W of all five layers.
    pub width: usize,
    /// Which layer the residual distance head reads.
    pub sdf_head: SdfHead,
    /// Whether the mask head also reads the view direction.
    pub mask_view: bool,
    /// Whether the colour head also reads the view direction.
    pub colour_view: bool,
}

/// What is wanted beyond the raw mask and the residual distance, which always come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Outputs {
    /// ∇mask and ∇residual with respect to the (scaled) point.
    pub gradient: bool,
    /// The colour head's raw linear values, no sigmoid.
    pub colour: bool,
    /// The last layer's activations h_5.
    pub activations: bool,
}

/// Where each output lies among the C rows of a result [B, k, C, N].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Rows {
    /// The raw mask.
    pub mask: usize,
    /// The residual distance.
    pub residual: usize,
    /// ∂mask/∂(x, y, z).
    pub mask_gradient: Option<Range<usize>>,
    /// ∂residual/∂(x, y, z).
    pub residual_gradient: Option<Range<usize>>,
    /// Three colour values.
    pub colour: Option<Range<usize>>,
    /// W activations.
    pub activations: Option<Range<usize>>,
    /// C, the number of all rows.
    pub count: usize,
}

/// A linear map inside a packed row of weights: `weight` is `outputs` x `inputs`, row-major; `bias` has `outputs` values.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Linear {
    /// Where the weight lies.
    pub weight: Range<usize>,
    /// Where the bias lies.
    pub bias: Range<usize>,
    /// Rows of the weight.
    pub outputs: usize,
    /// Columns of the weight.
    pub inputs: usize,
}

/// Where each parameter of a local generator lies in its packed row of weights.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// The five FiLM-SIREN layers, before FiLM.
    pub layers: [Linear; FILM_LAYERS],
    /// The mask head; view columns come last.
    pub mask: Linear,
    /// The residual distance head.
    pub residual: Linear,
    /// The colour head; view columns come last.
    pub colour: Linear,
}

impl Layout {
    /// Every linear map with its name: `layer1` … `layer5`, `mask`, `residual`, `colour`.
    pub fn named(&self) -> impl Iterator<Item = (&'static str, &Linear)> {
        let names = ["layer1", "layer2", "layer3", "layer4", "layer5", "mask", "residual", "colour"];
        names.into_iter().zip(self.layers.iter().chain([&self.mask, &self.residual, &self.colour]))
    }
}

impl HeadShape {
    /// Where each parameter lies in a packed row of weights.
    pub fn layout(&self) -> Layout {
        let mut end = 0;
        let mut take = |outputs: usize, inputs: usize| {
            let weight = end..end + outputs * inputs;
            let bias = weight.end..weight.end + outputs;
            end = bias.end;
            Linear { weight, bias, outputs, inputs }
        };
        let width = self.width;
        Layout {
            layers: std::array::from_fn(|layer| take(width, if layer == 0 { 3 } else { width })),
            mask: take(1, width + view_columns(self.mask_view)),
            residual: take(1, width),
            colour: take(3, width + view_columns(self.colour_view)),
        }
    }

    /// P, the length of one region's packed row of weights.
    pub fn parameter_count(&self) -> usize {
        self.layout().colour.bias.end
    }

    /// Values per point: 3, or 6 when a head reads the view direction.
    pub fn point_columns(&self) -> usize {
        3 + view_columns(self.mask_view || self.colour_view)
    }

    /// The layer (1-based) whose activations the residual distance head reads.
    pub fn residual_depth(&self) -> usize {
        match self.sdf_head {
            SdfHead::Shape => SHAPE_LAYERS,
            SdfHead::Texture => FILM_LAYERS,
        }
    }

    /// How many of the five layers `outputs` needs.
    pub fn depth(&self, outputs: Outputs) -> usize {
        if outputs.colour || outputs.activations { FILM_LAYERS } else { self.residual_depth() }
    }

    /// The rows of a result [B, k, C, N].
    pub fn rows(&self, outputs: Outputs) -> Rows {
        let mut count = 2;
        let mut take = |wanted: bool, rows: usize| {
            wanted.then(|| {
                count += rows;
                count - rows..count
            })
        };
        Rows {
            mask: 0,
            residual: 1,
            mask_gradient: take(outputs.gradient, 3),
            residual_gradient: take(outputs.gradient, 3),
            colour: take(outputs.colour, 3),
            activations: take(outputs.activations, self.width),
            count,
        }
    }
}

fn view_columns(reads_view: bool) -> usize {
    if reads_view { 3 } else { 0 }
}

/// One evaluation's sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Extent {
    /// B, images: each has its own points and FiLM.
    pub images: usize,
    /// k, regions: each has its own weights and FiLM.
    pub regions: usize,
    /// N, points of each image.
    pub points: usize,
}

/// One evaluation: every region at every point of its image. Slices are checked to have their stated lengths.
#[derive(Clone, Copy)]
pub struct Evaluation<'a, T> {
    pub(crate) shape: HeadShape,
    pub(crate) outputs: Outputs,
    pub(crate) extent: Extent,
    /// [B, N, 3 or 6]
    pub(crate) points: &'a [T],
    /// [k, P]
    pub(crate) weights: &'a [T],
    /// [B, k, 5, 2, W]: γ then β
    pub(crate) film: &'a [T],
}

impl<'a, T> Evaluation<'a, T> {
    /// `points` [B, N, 3 or 6] scaled to network units, then the view direction if a head reads it; `weights` [k, P]
    /// as [`HeadShape::layout`]; `film` [B, k, 5, 2, W]. Errs if a slice has another length.
    pub fn new(
        shape: HeadShape,
        outputs: Outputs,
        extent: Extent,
        points: &'a [T],
        weights: &'a [T],
        film: &'a [T],
    ) -> Result<Self> {
        let Extent { images, regions, points: count } = extent;
        if shape.width == 0 {
            return Err(Error::config("field.width", "must be at least 1"));
        }
        check_length("points", [images, count, shape.point_columns()].as_slice(), points.len())?;
        check_length("weights", [regions, shape.parameter_count()].as_slice(), weights.len())?;
        check_length("film", [images, regions, FILM_LAYERS, 2, shape.width].as_slice(), film.len())?;
        Ok(Self { shape, outputs, extent, points, weights, film })
    }

    /// The number of values of a result: B · k · C · N.
    pub fn result_len(&self) -> usize {
        let Extent { images, regions, points } = self.extent;
        images * regions * self.shape.rows(self.outputs).count * points
    }
}

/// Where a backward pass leaves its gradients; each has its input's shape and is overwritten.
pub struct Gradients<'a, T> {
    /// [B, N, 3 or 6]; costs memory for every region, so only on demand.
    pub points: Option<&'a mut [T]>,
    /// [k, P]
    pub weights: &'a mut [T],
    /// [B, k, 5, 2, W]
    pub film: &'a mut [T],
}

impl<T> Gradients<'_, T> {
    /// Errs unless every slice has its input's length.
    pub fn check(&self, evaluation: &Evaluation<'_, T>) -> Result<()> {
        if let Some(points) = &self.points {
            check_length("points' gradient", &[evaluation.points.len()], points.len())?;
        }
        check_length("weights' gradient", &[evaluation.weights.len()], self.weights.len())?;
        check_length("film's gradient", &[evaluation.film.len()], self.film.len())
    }
}

pub(crate) fn check_length(name: &str, expected: &[usize], found: usize) -> Result<()> {
    if expected.iter().product::<usize>() == found { Ok(()) } else { Err(Error::shape(name, expected, &[found])) }
}

/// A way to evaluate local generators on this processor. Results do not depend on the number of threads.
pub trait RegionKernel<T>: Send + Sync {
    /// The name `CNERF_KERNEL` selects it by.
    fn name(&self) -> &'static str;

    /// Whether this processor can run it.
    fn available(&self) -> bool;

    /// Writes the result [B, k, C, N], rows as [`HeadShape::rows`].
    ///
    /// # Errors
    /// If `result` has another length or the processor cannot run this kernel.
    fn forward(&self, evaluation: &Evaluation<'_, T>, result: &mut [T]) -> Result<()>;

    /// Writes the gradients of Σ upstream ∘ result, the gradient rows' share (the double backward) included.
    ///
    /// # Errors
    /// If a slice has another length or the processor cannot run this kernel.
    fn backward(&self, evaluation: &Evaluation<'_, T>, upstream: &[T], gradients: Gradients<'_, T>) -> Result<()>;

    /// One region of one image, `weights` [P] and `film` [5, 2, W], made ready for lists of points.
    ///
    /// # Errors
    /// If a slice has another length or the processor cannot run this kernel.
    fn prepare(
        &self,
        shape: HeadShape,
        outputs: Outputs,
        weights: &[T],
        film: &[T],
    ) -> Result<Box<dyn PreparedRegion<T>>>;
}

/// Every kernel, the fastest first; whether the processor can run one is for [`RegionKernel::available`] to say.
pub fn kernels() -> impl Iterator<Item = &'static dyn RegionKernel<f32>> {
    #[cfg(target_arch = "x86_64")]
    let wide: [&dyn RegionKernel<f32>; 2] = [&fused::AVX512, &fused::AVX2];
    #[cfg(target_arch = "aarch64")]
    let wide: [&dyn RegionKernel<f32>; 1] = [&fused::NEON];
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    let wide: [&dyn RegionKernel<f32>; 0] = [];
    wide.into_iter().chain([&fused::PORTABLE as &dyn RegionKernel<f32>, &plain::Plain])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn layouts_tile_the_packed_row_in_the_agreed_order() {
        let shape = HeadShape { width: 5, sdf_head: SdfHead::Shape, mask_view: true, colour_view: false };
        let layout = shape.layout();
        let mut end = 0;
        for (name, linear) in layout.named() {
            assert_eq!((linear.weight.start, linear.bias.start), (end, linear.weight.end), "{name}");
            assert_eq!((linear.weight.len(), linear.bias.len()), (linear.outputs * linear.inputs, linear.outputs));
            end = linear.bias.end;
        }
        assert_eq!(end, shape.parameter_count());
        assert_eq!((layout.mask.inputs, layout.residual.inputs, layout.colour.inputs), (8, 5, 5));
    }

    #[test]
    fn rows_follow_the_contract() {
        let shape = HeadShape { width: 7, sdf_head: SdfHead::Texture, mask_view: false, colour_view: false };
        let rows = shape.rows(Outputs { gradient: true, colour: true, activations: true });
        assert_eq!((rows.mask_gradient, rows.residual_gradient), (Some(2..5), Some(5..8)));
        assert_eq!((rows.colour, rows.activations, rows.count), (Some(8..11), Some(11..18), 18));
        let rows = shape.rows(Outputs { colour: true, ..Outputs::default() });
        assert_eq!((rows.mask_gradient, rows.colour, rows.count), (None, Some(2..5), 5));
    }
}
