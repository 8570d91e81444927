//! Adversarial losses and their exact gradient penalties.
//!
//! The penalties take gradients that a network's explicit gradient graph has laid down
//! ([`crate::model::discriminator`], [`crate::model::upsampler::stylegan2`]), so first-order autograd of them is exact.

use candle_core::Tensor;

use crate::{
    error::Result,
    model::discriminator::{Discriminator, Judgement},
    train::losses,
};

/// log(1 + exp(x)), stable for any x.
pub fn softplus(x: &Tensor) -> Result<Tensor> {
    Ok((x.relu()? + (x.abs()?.neg()?.exp()? + 1.0)?.log()?)?)
}

/// The non-saturating generator loss: mean softplus(−realness of generated pictures).
pub fn generator_loss(fake: &Tensor) -> Result<Tensor> {
    Ok(softplus(&fake.neg()?)?.mean_all()?)
}

/// The logistic discriminator loss: mean softplus(−real) + mean softplus(fake).
pub fn logistic_loss(real: &Tensor, fake: &Tensor) -> Result<Tensor> {
    Ok((softplus(&real.neg()?)?.mean_all()? + softplus(fake)?.mean_all()?)?)
}

/// R1 (Mescheder et al. 2018): the squared norm of each picture's gradient `[B, …]`, averaged over the batch. A square
/// without root: finite, with a finite gradient, even where the gradient vanishes.
pub fn r1(gradient: &Tensor) -> Result<Tensor> {
    Ok(gradient.flatten_from(1)?.sqr()?.sum(1)?.mean_all()?)
}

/// γ of the two R1 penalties; half of each enters the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct R1Weights {
    /// On the gradient with respect to the image. Authors: 10.
    pub image: f64,
    /// On the gradient with respect to the masks. Authors: 1000.
    pub masks: f64,
}

impl R1Weights {
    /// The weights of a penalty taken every `steps` steps only: as strong on average.
    #[must_use]
    pub fn every(self, steps: usize) -> Self {
        Self { image: self.image * steps as f64, masks: self.masks * steps as f64 }
    }
}

/// What a discriminator predicts beside realness, with the truth.
#[derive(Clone, Copy, Debug)]
pub enum Auxiliary<'a> {
    /// Nothing.
    None,
    /// Azimuth and elevation of the generated pictures.
    View {
        /// `[B, 2]`, radians.
        angles_rad: &'a Tensor,
        /// λ_view; paper 15.
        weight: f64,
    },
    /// Region of real and generated pictures.
    Class {
        /// `[B]`, u32.
        labels: &'a Tensor,
        /// Paper 1.
        weight: f64,
    },
}

impl Auxiliary<'_> {
    /// The weighted loss of a prediction, if the discriminator makes one.
    fn loss(&self, judgement: &Judgement) -> Result<Option<Tensor>> {
        Ok(match (self, &judgement.view, &judgement.class) {
            (Self::View { angles_rad, weight }, Some(view), _) => Some((losses::view(view, angles_rad)? * *weight)?),
            (Self::Class { labels, weight }, _, Some(class)) => {
                Some((losses::classification(class, labels)? * *weight)?)
            }
            _ => None,
        })
    }
}

/// A discriminator's loss on a batch, and its weighted parts (scalars).
#[derive(Clone, Debug)]
pub struct DiscriminatorLoss {
    /// The sum of the parts.
    pub total: Tensor,
    /// Real against fake.
    pub logistic: Tensor,
    /// γ/2 of the image · R1.
    pub r1_image: Option<Tensor>,
    /// γ/2 of the masks · R1.
    pub r1_masks: Option<Tensor>,
    /// View or class.
    pub auxiliary: Option<Tensor>,
    /// Verdicts on the real pictures, `[B, 1]`, detached.
    pub real: Tensor,
}

/// Pictures and their masks as a discriminator takes them.
#[derive(Clone, Copy, Debug)]
pub struct Pictures<'a> {
    /// `[B, 3, r, r]` in [−1, 1].
    pub image: &'a Tensor,
    /// `[B, 9, r, r]`, or `[B, 1, r, r]` for the semantic discriminator.
    pub masks: &'a Tensor,
}

/// A discriminator's whole loss, as the authors assemble it: logistic; view on generated pictures, or class on real and
/// generated ones; R1 on real pictures where `penalty` is given. Detach generated pictures before.
pub fn discriminator_loss(
    discriminator: &Discriminator,
    real: Pictures<'_>,
    fake: Pictures<'_>,
    auxiliary: Auxiliary<'_>,
    penalty: Option<R1Weights>,
) -> Result<DiscriminatorLoss> {
    let fake = discriminator.forward(fake.image, fake.masks)?;
    let (real, penalties) = match penalty {
        None => (discriminator.forward(real.image, real.masks)?, None),
        Some(weights) => {
            let (judgement, gradients) = discriminator.forward_with_input_gradients(real.image, real.masks)?;
            let image = (r1(&gradients.image)? * (0.5 * weights.image))?;
            let masks = (r1(&gradients.masks)? * (0.5 * weights.masks))?;
            (judgement, Some((image, masks)))
        }
    };
    let mut on_predictions = auxiliary.loss(&fake)?;
    if let (Auxiliary::Class { .. }, Some(on_fake), Some(on_real)) =
        (auxiliary, &on_predictions, auxiliary.loss(&real)?)
    {
        on_predictions = Some((on_fake + on_real)?);
    }
    let logistic = logistic_loss(&real.realness, &fake.realness)?;
    let (r1_image, r1_masks) = penalties.unzip();
    let total =
        [&r1_image, &r1_masks, &on_predictions].into_iter().flatten().try_fold(logistic.clone(), |a, b| a + b)?;
    let real = real.realness.detach();
    Ok(DiscriminatorLoss { total, logistic, r1_image, r1_masks, auxiliary: on_predictions, real })
}

/// A generator's terms from one discriminator, and their weighted parts (scalars).
#[derive(Clone, Debug)]
pub struct GeneratorLoss {
    /// The sum of the parts.
    pub total: Tensor,
    /// Non-saturating.
    pub adversarial: Tensor,
    /// View or class.
    pub auxiliary: Option<Tensor>,
}

/// What `discriminator` asks of a generator: that its pictures look real, and that their view or class be seen.
pub fn generator_terms(
    discriminator: &Discriminator,
    fake: Pictures<'_>,
    auxiliary: Auxiliary<'_>,
) -> Result<GeneratorLoss> {
    let judgement = discriminator.forward(fake.image, fake.masks)?;
    let adversarial = generator_loss(&judgement.realness)?;
    let auxiliary = auxiliary.loss(&judgement)?;
    let total = auxiliary.iter().try_fold(adversarial.clone(), |sum, part| sum + part)?;
    Ok(GeneratorLoss { total, adversarial, auxiliary })
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

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    #[test]
    fn softplus_and_its_slope_hold_at_zero_and_far_out() {
        let x = Var::new(&[-1000f32, -20.0, 0.0, 3.0, 1000.0], &Device::Cpu).unwrap();
        let y = softplus(&x).unwrap();
        let slopes = y.sum_all().unwrap().backward().unwrap().get(&x).unwrap().to_vec1::<f32>().unwrap();
        let values = y.to_vec1::<f32>().unwrap();
        for (index, x) in x.to_vec1::<f32>().unwrap().into_iter().map(f64::from).enumerate() {
            let (value, slope) = (x.max(0.0) + (-x.abs()).exp().ln_1p(), 1.0 / (1.0 + (-x).exp()));
            assert!((f64::from(values[index]) - value).abs() < 1e-6 * (1.0 + value), "{x}: {}", values[index]);
            assert!((f64::from(slopes[index]) - slope).abs() < 1e-6, "{x}: {}", slopes[index]);
        }
    }

    #[test]
    fn path_lengths_of_a_dead_generator_are_finite() {
        let gradient = Var::zeros((2, 1, 4), candle_core::DType::F32, &Device::Cpu).unwrap();
        let mean = Tensor::new(0.5f32, &Device::Cpu).unwrap();
        let path = PathLength::new(&[gradient.as_tensor().clone()], &mean, 0.01).unwrap();
        let slopes = path.penalty.backward().unwrap();
        let slopes = slopes.get(&gradient).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert!(slopes.iter().all(|slope| slope.is_finite()));
        assert!((path.mean.to_scalar::<f32>().unwrap() - 0.495).abs() < 1e-6);
    }
}
