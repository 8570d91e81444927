//! Adversarial losses and their exact gradient penalties.
//!
//! The penalties take gradients that a network's explicit gradient graph has laid down
//! ([`crate::model::discriminator`], [`crate::model::upsampler::stylegan2`]), so first-order autograd of them is exact.

use candle_core::Tensor;

use crate::error::Result;

/// log(1 + exp(x)), stable for any x.
pub fn softplus(x: &Tensor) -> Result<Tensor> {
    Ok((x.relu()? + (x.abs()?.neg()?.exp()? + 1.0)?.log()?)?)
}

/// Path-length regularisation of StyleGAN2 (Karras et al. 2020, §3.2), as in the authors' `g_path_regularize`.
#[derive(Clone, Debug)]
pub struct PathLength {
    /// Mean squared deviation of the lengths from their running mean, a scalar.
    pub penalty: Tensor,
    /// The running mean after this batch, detached: hand it to the next call.
    pub mean: Tensor,
    /// Length of each picture's path, `[B]`.
    pub lengths: Tensor,
}

impl PathLength {
    /// `latent_gradient`: d(Σ rgb · noise / √(H W)) / d latent for every layer, each `[B, R, L]`. `previous_mean` is a
    /// scalar (0 at the start of training), `decay` the weight of the new batch (0.01).
    pub fn new(latent_gradient: &[Tensor], previous_mean: &Tensor, decay: f64) -> Result<Self> {
        let gradient = Tensor::cat(latent_gradient, 1)?;
        // Far below any length that matters: a square root's slope at exactly zero is infinite.
        let lengths = (gradient.sqr()?.sum(2)?.mean(1)? + 1e-20)?.sqrt()?;
        let previous_mean = previous_mean.detach();
        let moved = ((lengths.mean_all()? - &previous_mean)? * decay)?;
        // Not detached inside the penalty, as in the authors' code.
        let mean = (previous_mean + moved)?;
        let penalty = lengths.broadcast_sub(&mean)?.sqr()?.mean_all()?;
        Ok(Self { penalty, mean: mean.detach(), lengths })
    }
}
