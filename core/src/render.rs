//! Rays to pictures over any field: a small trait here (points to distance, masks, colour, features), so that
//! rendering never knows a model.

use candle_core::Tensor;

use crate::{
    camera::Rays,
    error::{Error, Result},
    kernels::parts::Parts,
    region::RegionSet,
};

pub mod frame;
pub mod integrate;
pub mod plan;
pub mod sampling;
pub mod surface;
pub mod trajectory;

pub use crate::kernels::Outputs;
pub use frame::{Frame, RenderSettings, render_frame, render_rays};
pub use integrate::{RayOutput, RayWeights};
pub use sampling::{Placement, Sampling};
pub use surface::TwoPass;

/// A field at N points of B portraits. `k` counts the volume's regions, rows in label order.
#[derive(Clone, Debug)]
pub struct Evaluation {
    /// Signed distance to the surface, world units, negative inside: `[B, N]`.
    pub distance: Tensor,
    /// Fusion weights m_i of the regions: `[B, k, N]`.
    pub masks: Tensor,
    /// What each region adds to the distance before gating, world units: `[B, k, N]`.
    pub residuals: Tensor,
    /// Colours c_i before fusion and sigmoid: `[B, k, 3, N]`.
    pub colours: Option<Tensor>,
    /// Last hidden layers: `[B, k, W, N]`.
    pub activations: Option<Parts>,
    /// ∇d, without unit: `[B, 3, N]`.
    pub gradient: Option<Tensor>,
}

/// What lies on the far plane, where a field's background is there.
#[derive(Clone, Debug)]
pub struct BackgroundEvaluation {
    /// Colour before the sigmoid: `[B, 3, R]`.
    pub colour: Tensor,
    /// Last hidden layer of the background region: `[B, W, R]`.
    pub activations: Option<Tensor>,
}

/// A field that can be rendered: the nine regions of B portraits, their codes fixed.
pub trait RadianceField {
    /// The regions that live in the volume: their number is the `k` of an [`Evaluation`].
    fn volume_regions(&self) -> RegionSet;

    /// Whether any output depends on the direction a point is seen from.
    fn sees_view(&self) -> bool;

    /// The field at `points` `[B, N, 3]`, world, seen along the unit vectors `view_directions` `[B, N, 3]`. Without
    /// directions, what depends on them is evaluated for the zero vector.
    fn evaluate(&self, points: &Tensor, view_directions: Option<&Tensor>, outputs: Outputs) -> Result<Evaluation>;

    /// Volume density, 1 / world units, where the signed distance is `distance` (any shape), world units.
    fn density(&self, distance: &Tensor) -> Result<Tensor>;

    /// The background at `points` `[B, R, 3]` of the far plane; none if it is a region of the volume.
    fn background(
        &self,
        points: &Tensor,
        view_directions: Option<&Tensor>,
        activations: bool,
    ) -> Result<Option<BackgroundEvaluation>>;

    /// Features `[B, F, R]` from activations `[B, 9, W, R]` that were weighted and summed along rays, the sums of
    /// those weights `[B, 9, R]`, and view directions `[B, R, 3]`. Features are linear in activations, so this
    /// equals the weighted sum of the samples' features at a fraction of its cost.
    fn features(&self, activations: &Tensor, masks: &Tensor, view_directions: Option<&Tensor>) -> Result<Tensor>;

    /// Portrait number `portrait` as plain numbers, for [`plan`]s; none where there are none to be had (another device
    /// or number type).
    fn local(&self, portrait: usize) -> Result<Option<plan::LocalField>> {
        let _ = portrait;
        Ok(None)
    }

    /// The same field with no way back to its weights and codes: what is rendered from it holds no graph in memory.
    #[must_use]
    fn detached(&self) -> Self
    where
        Self: Sized;
}

/// Rays of B portraits and the directions their samples are seen from.
#[derive(Clone, Debug)]
pub struct RayBundle {
    /// `[B, 1, 3]`, world.
    pub origins: Tensor,
    /// `[B, R, 3]`, world, un-normalised.
    pub directions: Tensor,
    /// `[B, R, 3]`, unit length.
    pub view_directions: Tensor,
}

impl RayBundle {
    /// Rays seen along themselves.
    pub fn new(rays: Rays) -> Result<Self> {
        let view_directions = rays.directions.broadcast_div(&norm(&rays.directions)?.unsqueeze(2)?)?;
        Ok(Self { origins: rays.origins, directions: rays.directions, view_directions })
    }

    /// (B, R).
    pub fn dimensions(&self) -> Result<(usize, usize)> {
        match *self.directions.dims() {
            [batch, rays, 3] => Ok((batch, rays)),
            _ => Err(Error::shape("ray directions", "[B, R, 3]", self.directions.dims())),
        }
    }

    /// The rays `start .. start + length`.
    pub fn narrow(&self, start: usize, length: usize) -> Result<Self> {
        Ok(Self {
            origins: self.origins.clone(),
            directions: self.directions.narrow(1, start, length)?,
            view_directions: self.view_directions.narrow(1, start, length)?,
        })
    }

    /// Points at `depths` `[B, R, S]` (or 1 in place of B or R): `[B, R * S, 3]`, samples of a ray side by side.
    pub fn points(&self, depths: &Tensor) -> Result<Tensor> {
        let (batch, rays) = self.dimensions()?;
        let samples = depths.dim(2)?;
        let steps = self.directions.unsqueeze(2)?.broadcast_mul(&depths.unsqueeze(3)?)?;
        Ok(steps.broadcast_add(&self.origins.unsqueeze(2)?)?.reshape((batch, rays * samples, 3))?)
    }

    /// View directions of those points, `[B, R * S, 3]`.
    pub fn view_directions_of(&self, samples: usize) -> Result<Tensor> {
        let (batch, rays) = self.dimensions()?;
        let repeated = self.view_directions.unsqueeze(2)?.expand((batch, rays, samples, 3))?;
        Ok(repeated.reshape((batch, rays * samples, 3))?)
    }

    /// Lengths of the directions, `[B, R]`: world units per unit of depth.
    pub fn lengths(&self) -> Result<Tensor> {
        norm(&self.directions)
    }
}

/// Euclidean norm over the last dimension; its gradient at the zero vector is 0.
///
/// The guard is 1e-16 under the root: at a length of 1e-4 world units (a two-thousandth of the volume) it adds
/// a share of 5e-9, less than f32 can show.
pub fn norm(vectors: &Tensor) -> Result<Tensor> {
    norm_over(vectors, vectors.rank().saturating_sub(1))
}

/// [`norm`] over another dimension.
pub fn norm_over(vectors: &Tensor, dimension: usize) -> Result<Tensor> {
    Ok((vectors.sqr()?.sum(dimension)? + 1e-16)?.sqrt()?)
}
