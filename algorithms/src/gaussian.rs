//! The Gaussian policy that several algorithms train by weighted regression: its mean is the tanh
//! of a network, its log σ the same in all states.

use candle_core::{Result, Tensor};
use quad_nn::{AdamStep, Ensemble, Gradients, MlpConfig, Tensors, Weights};
use quad_policy::{GaussianPolicy, GaussianShape, PolicyConfig, Spread, gaussian_mean};

use super::networks::{Initializer, TrainState};
use super::state_dict::{StateDict, Stateful};

/// Bounds of log σ.
const LOG_STD: (f32, f32) = (-5.0, 2.0);

pub(super) struct Gaussian {
    /// Network whose tanh is the mean.
    mean: TrainState<Ensemble>,
    /// log σ, `[a]`.
    log_std: TrainState<Weights>,
}

impl Gaussian {
    pub fn new(layers: &MlpConfig, init: &mut Initializer<'_>) -> Result<Self> {
        let a = init.context.action_dim();
        Ok(Self {
            mean: init.state_network(layers, a)?,
            log_std: init.numbers("log_std", &vec![0.0; a])?,
        })
    }

    /// log π(a|s), `[B]`.
    pub fn log_probability(&self, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
        log_density(actions, &gaussian_mean(&self.mean, observations)?, &self.log_std()?)
    }

    /// Moves mean and log σ down a loss `[]`.
    pub fn minimize(&mut self, loss: &Tensor, step: AdamStep) -> Result<()> {
        let gradients = Gradients::backward(loss)?;
        self.mean.apply_gradients(&gradients, step)?;
        self.log_std.apply_gradients(&gradients, step)?;
        Ok(())
    }

    /// The policy that acts by the mean and explores by draws.
    pub fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        gaussian_policy(&self.mean, Spread::Shared, Some(self.log_std()?.detach()))
    }

    /// log σ, `[a]`.
    fn log_std(&self) -> Result<Tensor> {
        self.log_std.values().clamp(LOG_STD.0, LOG_STD.1)
    }
}

impl Stateful for Gaussian {
    fn add_to<'a>(&'a mut self, dict: &mut StateDict<'a>, name: &str) {
        self.mean.add_to(dict, name);
        self.log_std.add_to(dict, name);
    }
}

/// log π(a|s), `[B]`, of actions and means `[B, a]`; log σ is `[B, a]`, or `[a]` in all states. The
/// mean is after the tanh, so there is no Jacobian.
pub(super) fn log_density(actions: &Tensor, mean: &Tensor, log_std: &Tensor) -> Result<Tensor> {
    let square = (actions - mean)?.broadcast_div(&log_std.exp()?)?.sqr()?;
    let half_log_2_pi = 0.5 * (2.0 * std::f64::consts::PI).ln();
    ((square * -0.5)?.broadcast_sub(log_std)? - half_log_2_pi)?.sum(1)
}

/// The policy that acts by the tanh of a network's output, in its first half with
/// [`Spread::Squashed`]; with [`Spread::Shared`] `log_std` is its log σ, `[a]`.
pub(super) fn gaussian_policy(
    network: &Ensemble,
    spread: Spread,
    log_std: Option<Tensor>,
) -> Result<(PolicyConfig, Tensors)> {
    let shape = network.shape();
    let halves = if spread == Spread::Squashed { 2 } else { 1 };
    let shape = GaussianShape {
        observation_dim: shape.observation_dim,
        action_dim: shape.outputs / halves,
        actor: shape.layers.clone(),
        spread,
    };
    Ok((PolicyConfig::Gaussian { shape }, GaussianPolicy::tensors(network, log_std)?))
}

/// The policy that acts by the tanh of the first half of a network's output `[n, 2a]`.
pub(super) fn first_half_policy(network: &Ensemble) -> Result<(PolicyConfig, Tensors)> {
    let (mut policy, mut tensors) = gaussian_policy(network, Spread::None, None)?;
    let a = network.shape().outputs / 2;
    if let PolicyConfig::Gaussian { shape } = &mut policy {
        shape.action_dim = a;
    }
    let last = format!(".{}.", network.shape().layers.hidden.len());
    for (_, tensor) in tensors.iter_mut().filter(|(name, _)| name.contains(&last)) {
        *tensor = tensor.narrow(tensor.rank() - 1, 0, a)?.contiguous()?;
    }
    Ok((policy, tensors))
}
