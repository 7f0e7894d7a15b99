//! The critics' gradients at noisy actions, or at what these denoise to, and their weight: λ of
//! Eq. 24, or a control in its place.

use super::config::{Config, Guidance, GuidanceAt};
use super::noise::Noise;
use crate::batch::Batch;
use crate::state_dict::{StateDict, write};
use candle_core::{DType, Device, Result, Tensor};
use quad_nn::{Ensemble, mean_and_variance};

/// λ = ν̂²/(ν̂² + σ²/τ + δ) (Eq. 24) of ν̂², `[]`, and σ², `[B]`, or the weight in its place, `[B]`;
/// and the share of the batch in which δ decides λ, `[]`.
fn lambda(
    nu_squared: &Tensor,
    sigma_squared: &Tensor,
    config: &Config,
) -> Result<(Tensor, Tensor)> {
    let (ones, zero) = (sigma_squared.ones_like()?, nu_squared.zeros_like()?);
    match config.guidance {
        Guidance::Quad | Guidance::Mean | Guidance::Shuffled => {
            let (tau, delta) = (f64::from(config.tau), f64::from(*config.delta));
            let scaled = sigma_squared.affine(1.0 / tau, delta)?;
            let denominator = scaled.broadcast_add(nu_squared)?;
            let decided = denominator.lt(100.0 * delta)?.to_dtype(DType::F32)?;
            let lambda = denominator.recip()?.broadcast_mul(nu_squared)?;
            Ok((lambda, decided.mean_all()?))
        }
        Guidance::Dac | Guidance::None => Ok((ones, zero)),
        Guidance::Constant => {
            let lambda = config.lambda.map_or(1.0, |lambda| f64::from(*lambda));
            Ok((ones.affine(lambda, 0.0)?, zero))
        }
    }
}

/// Guidance at noisy actions; constants.
pub(super) struct Guide {
    /// ḡ: the mean over critics of ∇_a Q̂_k(s, a^t), over the mean of |Q̂_k(s, a)| (Eq. 10), `[B,
    /// a]`; with `guidance_at` `denoised` of ∇_a Q̂_k(s, â_0).
    pub gradient: Tensor,
    /// σ² (Eq. 22), `[B]`.
    pub sigma_squared: Tensor,
    /// The weight of ḡ: λ, or a control's, `[B]`.
    pub lambda: Tensor,
    /// Share of the batch in which δ decides λ, `[]`.
    pub delta_share: Tensor,
    /// The moving averages after this batch.
    pub averages: Averages,
}

/// Moving averages; below 0 where there is none yet.
pub(super) struct Averages {
    /// ν̂² (Eq. 23), `[]`.
    pub nu_squared: Tensor,
    /// With guidance `mean`: λ at each t, `[T]`.
    lambda_means: Option<Tensor>,
}

impl Averages {
    pub fn new(config: &Config, device: &Device) -> Result<Self> {
        let nu_squared = Tensor::new(-1f32, device)?;
        let unset = || Tensor::full(-1f32, *config.diffusion_steps, device);
        let lambda_means = (config.guidance == Guidance::Mean).then(unset);
        let lambda_means = lambda_means.transpose()?;
        Ok(Self { nu_squared, lambda_means })
    }

    /// Overwrites them with newer ones.
    pub fn set(&self, newer: &Self) -> Result<()> {
        write(&self.nu_squared, &newer.nu_squared)?;
        if let (Some(means), Some(newer)) = (&self.lambda_means, &newer.lambda_means) {
            write(means, newer)?;
        }
        Ok(())
    }

    pub fn add_to<'a>(&'a mut self, dict: StateDict<'a>) -> StateDict<'a> {
        let dict = dict.with("nu_squared", &mut self.nu_squared);
        dict.with("lambda_means", &mut self.lambda_means)
    }

    /// Guidance by the target critics at noisy actions, for which the actor predicts this noise,
    /// both `[B, a]`.
    pub fn guide(
        &self,
        config: &Config,
        critics: &Ensemble,
        batch: &Batch,
        noise: &Noise,
        (noisy, predicted): (&Tensor, &Tensor),
    ) -> Result<Guide> {
        let values = batch.values(critics)?;
        let guided = match config.guidance_at {
            GuidanceAt::Noisy => noisy.clone(),
            GuidanceAt::Denoised => noise.denoising.clean(noisy, predicted)?,
        };
        let gradients = critics.action_gradients(&batch.observations, &guided)?;
        // Critics align in actions that are guided, not in those beyond the end of an episode.
        let within = |x: &Tensor| match &batch.within {
            Some(within) => x.broadcast_mul(within),
            None => Ok(x.clone()),
        };
        let (gradients, predicted) = (within(&gradients)?, within(predicted)?);
        #[cfg(feature = "cuda")]
        if config.guidance == Guidance::Quad && noisy.device().is_cuda() {
            return self.guide_on_gpu(config, [&values, &gradients, &predicted]);
        }
        let scale = (values.abs()?.mean_all()? + 1e-6)?;
        let gradients = gradients.broadcast_div(&scale)?;

        let size = (predicted.sqr()?.sum_keepdim(1)?.sqrt()? + 1e-8)?;
        let direction = predicted.broadcast_div(&size)?; // u, Eq. 21
        let alignment = gradients.broadcast_mul(&direction)?.sum(2)?; // l_k = u·g_k, [K, B]
        let (mean, sigma_squared) = mean_and_variance(&alignment)?; // l̄, and σ² of Eq. 22
        let spread = mean.broadcast_sub(&mean.mean_all()?)?.sqr()?.mean_all()?;
        let before = &self.nu_squared;
        let average = (before + ((&spread - before)? * f64::from(*config.nu_ema_rate))?)?;
        let nu_squared = before.lt(0f32)?.where_cond(&spread, &average)?; // Eq. 23

        let (mut weight, delta_share) = lambda(&nu_squared, &sigma_squared, config)?;
        let t = &noise.denoising.t;
        let lambda_means = self.lambda_means.as_ref();
        let lambda_means =
            lambda_means.map(|before| means_by_step(before, &weight, t, config)).transpose()?;
        if let Some(means) = &lambda_means {
            weight = means.index_select(&(t - t.ones_like()?)?, 0)?;
        }
        if let Some(permutation) = &noise.permutation {
            weight = weight.index_select(permutation, 0)?;
        }
        Ok(Guide {
            gradient: mean_and_variance(&gradients)?.0,
            sigma_squared,
            lambda: weight,
            delta_share,
            averages: Averages { nu_squared, lambda_means },
        })
    }
}

#[cfg(feature = "cuda")]
impl Averages {
    /// Guidance from the critics' values and gradients, in one kernel.
    fn guide_on_gpu(
        &self,
        config: &Config,
        [values, gradients, predicted]: [&Tensor; 3],
    ) -> Result<Guide> {
        let (rows, a) = predicted.dims2()?;
        let numbers = [config.tau, *config.delta, *config.nu_ema_rate];
        let numbers = quad_nn::guide([values, gradients, predicted, &self.nu_squared], numbers)?;
        let scalar = |place: usize| numbers.narrow(0, rows * (a + 2) + place, 1)?.reshape(());
        Ok(Guide {
            gradient: numbers.narrow(0, 0, rows * a)?.reshape((rows, a))?,
            sigma_squared: numbers.narrow(0, rows * a, rows)?,
            lambda: numbers.narrow(0, rows * (a + 1), rows)?,
            delta_share: scalar(0)?,
            averages: Averages { nu_squared: scalar(1)?, lambda_means: None },
        })
    }
}

/// λ's average at each t after this batch, `[T]`: the batch's mean where there is none yet (below
/// 0), and as before where the batch has no such t.
fn means_by_step(before: &Tensor, lambda: &Tensor, t: &Tensor, config: &Config) -> Result<Tensor> {
    let steps = Tensor::arange(1, 1 + before.elem_count() as u32, t.device())?.unsqueeze(1)?;
    let is_at = steps.broadcast_eq(&t.unsqueeze(0)?)?.to_dtype(DType::F32)?; // [T, B]
    let count = is_at.sum(1)?;
    let mean = (is_at.broadcast_mul(lambda)?.sum(1)? / count.maximum(1f32)?)?;
    let rate = f64::from(*config.nu_ema_rate);
    let is_first = before.lt(0f32)?.to_dtype(DType::F32)?;
    let rate = is_first.affine(1.0 - rate, rate)?;
    before + ((mean - before)? * (rate * count.minimum(1f32)?)?)?
}
