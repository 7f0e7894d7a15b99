//! The Gaussian policy that several algorithms train by weighted regression: its mean is the tanh of a network, its log σ the
//! same in all states.

use candle_core::{DType, Result, Tensor};
use quad_policy::{
    AdamStep, Ensemble, GaussianPolicy, GaussianShape, Gradients, Layout, MlpConfig, Part, PolicyConfig, Start,
    Tensors, Weights, gaussian_mean,
};

use super::context::Context;
use super::parts::Parts;
use super::trained::{Trained, ensemble};

/// Bounds of log σ.
const LOG_STD: (f32, f32) = (-5.0, 2.0);

/// A Gaussian policy in training.
pub(super) struct Gaussian {
    shape: GaussianShape,
    /// The mean is its tanh.
    mean: Trained<Ensemble>,
    /// log σ, `[a]`.
    log_std: Trained<Weights>,
}

impl Gaussian {
    pub fn new(layers: &MlpConfig, context: &Context, network: u64) -> Result<Self> {
        let action_dim = context.action_dim();
        let shape = GaussianShape { observation_dim: context.observation_dim(), action_dim, actor: layers.clone() };
        let part = Part { name: "log_std".to_owned(), shape: vec![action_dim], start: Start::Constant(0.0) };
        let log_std = Tensor::zeros(action_dim, DType::F32, &context.device)?;
        let log_std = Weights::trainable(Layout::new(vec![part]), &log_std)?;
        Ok(Self { mean: ensemble(shape.actor(), context, network)?, log_std: Trained::new(log_std, 0.0)?, shape })
    }

    /// log π(a|s), `[B]`.
    pub fn log_probability(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let log_std = self.log_std.network.values().clamp(LOG_STD.0, LOG_STD.1)?;
        log_density(actions, &gaussian_mean(&self.mean.network, observations)?, &log_std)
    }

    /// Moves mean and log σ down a loss `[]`.
    pub fn descend(&mut self, loss: &Tensor, step: AdamStep) -> Result<()> {
        let gradients = Gradients::of(loss)?;
        self.mean.descend_along(&gradients, step)?;
        self.log_std.descend_along(&gradients, step)?;
        Ok(())
    }

    /// The policy that acts by the mean.
    pub fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let tensors = GaussianPolicy::tensors(&self.mean.network)?;
        Ok((PolicyConfig::Gaussian { shape: self.shape.clone() }, tensors))
    }

    /// Both parts, called `actor`.
    pub fn parts<'a>(&'a mut self, parts: Parts<'a>) -> Parts<'a> {
        parts.trained("actor", &mut self.mean).trained("actor", &mut self.log_std)
    }
}

/// log π(a|s), `[B]`, of actions and means `[B, a]`; log σ is `[B, a]`, or `[a]` in all states. The tanh is part of the mean:
/// the density knows nothing of it.
pub(super) fn log_density(actions: &Tensor, mean: &Tensor, log_std: &Tensor) -> Result<Tensor> {
    let square = (actions - mean)?.broadcast_div(&log_std.exp()?)?.sqr()?;
    let half_log_2_pi = 0.5 * (2.0 * std::f64::consts::PI).ln();
    ((square * -0.5)?.broadcast_sub(log_std)? - half_log_2_pi)?.sum(1)
}
