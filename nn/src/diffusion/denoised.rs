//! The critics' gradients at the denoised estimate of a noisy action, instead of at the noisy action,
//! which critics do not know from their training. The estimate's Jacobian is taken as the identity
//! (QGF, arXiv 2606.11087).

use crate::diffusion::noise_predictor::NoisePredictor;
use crate::ensemble::Ensemble;
use crate::layers::plain::repeat_rows;
use crate::shape::TIME_EMBEDDING;
use crate::statistics::mean_and_variance;
use candle_core::{Result, Tensor};

/// Noisy actions a^t, denoised in one step; constants.
pub struct Denoised {
    /// The predicted noise ε_θ(a^t, s, t), `[rows, a]`.
    pub epsilon: Tensor,
    /// The estimate â_0 = (a^t − √(1 − ᾱ_t)·ε_θ)/√ᾱ_t, clipped to ±1, `[rows, a]`.
    pub actions: Tensor,
    /// ∇_a Q_k(s, â_0) of each critic, `[K, rows, a]`.
    pub gradients: Tensor,
}

impl NoisePredictor {
    /// Denoises actions a^t `[rows, a]` of one t in 1..=T, and takes the critics' gradients there. The
    /// first rows/n rows belong to the first of `observations`, `[n, o]`, and so on.
    pub fn denoised(
        &self,
        critics: &Ensemble,
        observations: &Tensor,
        actions: &Tensor,
        t: usize,
    ) -> Result<Denoised> {
        let rows = actions.dim(0)?;
        let observations = &repeat_rows(observations, rows / observations.dim(0)?.max(1))?;
        let times = Tensor::full(t as u32, rows, actions.device())?;
        let epsilon = self.predict(observations, actions, &times)?.detach();
        let actions = self.schedule().clean(t, actions, &epsilon)?;
        let actions = actions.clamp(-1f32, 1f32)?;
        let gradients = critics.action_gradients(observations, &actions)?;
        Ok(Denoised { epsilon, actions, gradients })
    }

    /// [`Self::sample`] in f32, with the reverse process of the density that is proportional to
    /// π_θ·exp(`strength`·Q): each step takes ε_θ − strength·√(1 − ᾱ_t)·∇_a Q(s, â_0) as the noise,
    /// with Q the critics' mean.
    pub fn sample_guided(
        &self,
        observations: &Tensor,
        noise: &Tensor,
        critics: &Ensemble,
        strength: f32,
    ) -> Result<Tensor> {
        self.check_noise(observations, noise)?;
        let observations = repeat_rows(observations, noise.dim(1)? / observations.dim(0)?)?;
        self.reverse_process(noise, |t, actions| {
            let denoised = self.denoised(critics, &observations, actions, t)?;
            let pull = f64::from(strength * self.schedule().deviation(t));
            denoised.epsilon - (mean_and_variance(&denoised.gradients)?.0 * pull)?
        })
    }

    /// Numbers held by [`Self::sample_guided`] beside its arguments and the networks' tiles.
    pub fn guided_floats(&self, rows: u128, critics: &Ensemble) -> u128 {
        let (o, a) = (self.shape().observation_dim, self.shape().action_dim);
        // Observations and embeddings, alone and side by side; gradients; and those of a step.
        let each = 2 * (o + TIME_EMBEDDING) + (critics.shape().members + 16) * a;
        rows * each as u128
    }
}
