//! The critics' gradients at noisy actions, and how far each is trusted: by λ of Eq. 24, or by what
//! a control has in its place.

use super::config::Guidance;
use super::{Noise, Quad};
use crate::context::Minibatch;
use crate::diffusion::Networks;
use candle_core::{DType, Result, Tensor};
use quad_nn::mean_and_variance;

/// What the critics say about noisy actions, and how far they are trusted; all of it constants.
pub(super) struct Guide {
    /// ḡ: the mean over critics of ∇_a Q̂_k(s, a^t), over the mean of |Q̂_k(s, a)| (Eq. 10), `[B,
    /// a]`.
    pub gradient: Tensor,
    /// ν̂² after this batch (Eq. 23), `[]`.
    pub nu_squared: Tensor,
    /// σ² (Eq. 22), `[B]`.
    pub sigma_squared: Tensor,
    /// The weight of ḡ: λ (Eq. 24), or a control's, `[B]`.
    pub lambda: Tensor,
    /// Share of the batch in which δ decides λ, `[]`.
    pub delta_share: Tensor,
    /// With guidance `mean`, its averages after this batch, `[T]`.
    pub lambda_means: Option<Tensor>,
}

impl Quad {
    /// The target critics' gradients at noisy actions, and the weight of each (Eq. 10 and 21–24).
    pub(super) fn guide(
        &self,
        networks: &Networks,
        batch: &Minibatch,
        noisy: &Tensor,
        predicted: &Tensor,
        noise: &Noise,
    ) -> Result<Guide> {
        let critics = &networks.target_critics;
        let scale =
            (critics.values(&batch.observations, &batch.actions)?.abs()?.mean_all()? + 1e-6)?;
        let gradients =
            critics.action_gradients(&batch.observations, noisy)?.broadcast_div(&scale)?;

        let size = (predicted.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-8)?;
        let direction = predicted.broadcast_div(&size)?; // u, Eq. 21
        let alignment = gradients.broadcast_mul(&direction)?.sum(2)?; // l_k = u·g_k, [K, B]
        let (mean, sigma_squared) = mean_and_variance(&alignment)?; // l̄, and σ² of Eq. 22
        let spread = mean.broadcast_sub(&mean.mean_all()?)?.sqr()?.mean_all()?;
        let nu_squared = match &self.nu_squared {
            Some(before) => (before + ((spread - before)? * f64::from(*self.config.nu_ema_rate))?)?,
            None => spread,
        };
        let (mut lambda, delta_share) = match self.config.guidance {
            Guidance::Quad | Guidance::Mean | Guidance::Shuffled => {
                self.agreement(&sigma_squared, &nu_squared)?
            }
            Guidance::Dac | Guidance::None => {
                (sigma_squared.ones_like()?, nu_squared.zeros_like()?)
            }
            Guidance::Constant => {
                let lambda = self.config.lambda.map_or(1.0, |lambda| f64::from(*lambda));
                (sigma_squared.ones_like()?.affine(lambda, 0.0)?, nu_squared.zeros_like()?)
            }
        };
        let t = &noise.denoising.t;
        let lambda_means =
            self.lambda_means.as_ref().map(|before| self.followed(before, &lambda, t));
        let lambda_means = lambda_means.transpose()?;
        if let Some(means) = &lambda_means {
            lambda = means.index_select(&(t - t.ones_like()?)?, 0)?;
        }
        if let Some(permutation) = &noise.permutation {
            lambda = lambda.index_select(permutation, 0)?;
        }
        let gradient = mean_and_variance(&gradients)?.0;
        Ok(Guide { gradient, nu_squared, sigma_squared, lambda, delta_share, lambda_means })
    }

    /// λ (Eq. 24), `[B]`, and the share of the batch in which δ decides it, `[]`.
    fn agreement(&self, sigma_squared: &Tensor, nu_squared: &Tensor) -> Result<(Tensor, Tensor)> {
        let (tau, delta) = (f64::from(self.config.tau), f64::from(*self.config.delta));
        let denominator = sigma_squared.affine(1.0 / tau, delta)?.broadcast_add(nu_squared)?;
        let decided = denominator.lt(100.0 * delta)?.to_dtype(DType::F32)?.mean_all()?;
        Ok((denominator.recip()?.broadcast_mul(nu_squared)?, decided))
    }

    /// λ's average at each t after this batch, `[T]`: the batch's mean where there is none yet
    /// (below 0), and as before where the batch has no such t.
    fn followed(&self, before: &Tensor, lambda: &Tensor, t: &Tensor) -> Result<Tensor> {
        let steps = Tensor::arange(1, 1 + before.elem_count() as u32, t.device())?.unsqueeze(1)?;
        let is_of = steps.broadcast_eq(&t.unsqueeze(0)?)?.to_dtype(DType::F32)?; // [T, B]
        let count = is_of.sum(1)?;
        let mean = (is_of.broadcast_mul(lambda)?.sum(1)? / count.maximum(1f32)?)?;
        let rate = f64::from(*self.config.nu_ema_rate);
        let rate = before.lt(0f32)?.to_dtype(DType::F32)?.affine(1.0 - rate, rate)?;
        before + ((mean - before)? * (rate * count.minimum(1f32)?)?)?
    }
}
