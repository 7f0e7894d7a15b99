//! The Gaussian policy that several algorithms train by weighted regression: its mean is the tanh
//! of a network, its log σ the same in all states.

use candle_core::{Result, Tensor};
use quad_nn::{AdamStep, Ensemble, Gradients, MlpConfig, Tensors, Weights};
use quad_policy::{GaussianPolicy, GaussianShape, PolicyConfig, gaussian_mean};

use super::context::Context;
use super::parts::Parts;
use super::train_state::{TrainState, ensemble, learned};

/// Bounds of log σ.
const LOG_STD: (f32, f32) = (-5.0, 2.0);

/// A Gaussian policy in training.
pub(super) struct Gaussian {
    shape: GaussianShape,
    /// The mean is its tanh.
    mean: TrainState<Ensemble>,
    /// log σ, `[a]`.
    log_std: TrainState<Weights>,
}

impl Gaussian {
    pub fn new(layers: &MlpConfig, context: &Context, network: u64) -> Result<Self> {
        let action_dim = context.action_dim();
        let shape = GaussianShape {
            observation_dim: context.observation_dim(),
            action_dim,
            actor: layers.clone(),
        };
        let log_std = learned("log_std", &vec![0.0; action_dim], context)?;
        Ok(Self { mean: ensemble(shape.actor(), context, network)?, log_std, shape })
    }

    /// log π(a|s), `[B]`.
    pub fn log_probability(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let log_std = self.log_std.network.values().clamp(LOG_STD.0, LOG_STD.1)?;
        log_density(actions, &gaussian_mean(&self.mean.network, observations)?, &log_std)
    }

    /// Moves mean and log σ down a loss `[]`.
    pub fn minimize(&mut self, loss: &Tensor, step: AdamStep) -> Result<()> {
        let gradients = Gradients::of(loss)?;
        self.mean.apply_gradients(&gradients, step)?;
        self.log_std.apply_gradients(&gradients, step)?;
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

/// log π(a|s), `[B]`, of actions and means `[B, a]`; log σ is `[B, a]`, or `[a]` in all states. The
/// tanh is part of the mean: the density knows nothing of it.
pub(super) fn log_density(actions: &Tensor, mean: &Tensor, log_std: &Tensor) -> Result<Tensor> {
    let square = (actions - mean)?.broadcast_div(&log_std.exp()?)?.sqr()?;
    let half_log_2_pi = 0.5 * (2.0 * std::f64::consts::PI).ln();
    ((square * -0.5)?.broadcast_sub(log_std)? - half_log_2_pi)?.sum(1)
}

/// The policy that acts by the tanh of the first half of what comes out of a network of these
/// hidden layers, `[n, 2a]`.
pub(super) fn first_half(
    network: &Ensemble,
    layers: &MlpConfig,
    context: &Context,
) -> Result<(PolicyConfig, Tensors)> {
    let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
    let mut tensors = GaussianPolicy::tensors(network)?;
    let last = format!(".{}.", layers.hidden.len());
    for (_, tensor) in tensors.iter_mut().filter(|(name, _)| name.contains(&last)) {
        *tensor = tensor.narrow(tensor.rank() - 1, 0, action_dim)?.contiguous()?;
    }
    let shape = GaussianShape { observation_dim, action_dim, actor: layers.clone() };
    Ok((PolicyConfig::Gaussian { shape }, tensors))
}
