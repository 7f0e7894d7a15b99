//! A tanh-squashed Gaussian policy in training (Haarnoja et al. 2018, "Soft Actor-Critic", appendix
//! C): a = tanh(u), where a network of the state gives mean and log σ of u. Actions are drawn with
//! a gradient, and their densities have the tanh's Jacobian.

use candle_core::{Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, Gradients, MlpConfig, Tensors, Weights};
use quad_policy::PolicyConfig;

use super::context::Context;
use super::gaussian::first_half;
use super::parts::Parts;
use super::train_state::{TrainState, ensemble, learned};

/// A squashed Gaussian policy in training.
pub(super) struct Squashed {
    layers: MlpConfig,
    /// Mean and x of each state, `[n, 2a]`.
    pub network: TrainState<Ensemble>,
    /// c₁ and c₂ where log σ is c₁·x + c₂; else it is x.
    map: Option<TrainState<Weights>>,
    /// Bounds of log σ.
    bounds: (f32, f32),
}

impl Squashed {
    /// At its beginning, as network number `network` of the run; `map` is what c₁ and c₂ begin
    /// with, where they are learned.
    pub fn new(
        layers: &MlpConfig,
        bounds: (f32, f32),
        map: Option<[f32; 2]>,
        context: &Context,
        network: u64,
    ) -> Result<Self> {
        let shape = EnsembleShape {
            members: 1,
            observation_dim: context.observation_dim(),
            action_dim: 0,
            layers: layers.clone(),
            outputs: 2 * context.action_dim(),
        };
        let map = map.map(|begin| learned("log_std_map", &begin, context)).transpose()?;
        Ok(Self {
            network: ensemble(shape, context, network)?,
            map,
            bounds,
            layers: layers.clone(),
        })
    }

    /// The distributions of u in these states, `[n, o]`; differentiable in all that is learned.
    pub fn distribution(&self, observations: &Tensor) -> Result<Normal> {
        self.of(&self.network.network, observations)
    }

    /// [`Self::distribution`] as constants.
    pub fn constant_distribution(&self, observations: &Tensor) -> Result<Normal> {
        Ok(self.of(&self.network.network.detach(), observations)?.detach())
    }

    fn of(&self, network: &Ensemble, observations: &Tensor) -> Result<Normal> {
        let out = network.state_outputs(observations)?.squeeze(0)?;
        let a = out.dim(1)? / 2;
        let (mean, x) = (out.narrow(1, 0, a)?, out.narrow(1, a, a)?);
        let log_std = match &self.map {
            Some(map) => {
                let c = map.network.values();
                x.broadcast_mul(&c.narrow(0, 0, 1)?)?.broadcast_add(&c.narrow(0, 1, 1)?)?
            }
            None => x,
        };
        Ok(Normal { mean, log_std: log_std.clamp(self.bounds.0, self.bounds.1)? })
    }

    /// Moves all that is learned down a loss `[]`.
    pub fn minimize(&mut self, loss: &Tensor, step: AdamStep) -> Result<()> {
        let gradients = Gradients::of(loss)?;
        self.network.apply_gradients(&gradients, step)?;
        if let Some(map) = &mut self.map {
            map.apply_gradients(&gradients, step)?;
        }
        Ok(())
    }

    /// The policy that acts by tanh(mean).
    pub fn policy(&self, context: &Context) -> Result<(PolicyConfig, Tensors)> {
        first_half(&self.network.network, &self.layers, context)
    }

    /// Its parts, called `actor`.
    pub fn parts<'a>(&'a mut self, parts: Parts<'a>) -> Parts<'a> {
        let parts = parts.trained("actor", &mut self.network);
        match &mut self.map {
            Some(map) => parts.trained("actor", map),
            None => parts,
        }
    }
}

/// Normal distributions of u, one for each of n states.
pub(super) struct Normal {
    /// `[n, a]`.
    pub mean: Tensor,
    /// log σ, `[n, a]`.
    pub log_std: Tensor,
}

/// Actions that were drawn, S for each state.
pub(super) struct Drawn {
    /// tanh(u), `[n, S, a]`.
    pub actions: Tensor,
    /// log π(a|s), `[n, S]`.
    pub log_density: Tensor,
}

impl Normal {
    /// Makes constants of the distributions.
    pub fn detach(&self) -> Self {
        Self { mean: self.mean.detach(), log_std: self.log_std.detach() }
    }

    /// Actions tanh(mean + σ·noise) for standard normal noise `[n, S, a]`. Actions and densities
    /// are differentiable in mean and log σ.
    pub fn draw(&self, noise: &Tensor) -> Result<Drawn> {
        let log_std = self.log_std.unsqueeze(1)?;
        let u = noise.broadcast_mul(&log_std.exp()?)?.broadcast_add(&self.mean.unsqueeze(1)?)?;
        Ok(Drawn { actions: u.tanh()?, log_density: log_density(&u, noise, &log_std)? })
    }

    /// log π(a|s), `[n]`, of actions within (−1, 1), `[n, a]`.
    pub fn log_density(&self, actions: &Tensor) -> Result<Tensor> {
        let u = (((1.0 + actions)?.log()? - (1.0 - actions)?.log()?)? * 0.5)?;
        let noise = ((&u - &self.mean)? / self.log_std.exp()?)?;
        log_density(&u, &noise, &self.log_std)
    }
}

/// log π(tanh u), summed over the last dimension, for noise (u − mean)/σ: log N(u) − log(1 − tanh²
/// u). The second is taken as 2·(log 2 − |u| − log(1 + e^(−2|u|))), which is exact also where tanh
/// u rounds to ±1.
fn log_density(u: &Tensor, noise: &Tensor, log_std: &Tensor) -> Result<Tensor> {
    let size = u.abs()?;
    let jacobian =
        ((size.affine(-2.0, 0.0)?.exp()? + 1.0)?.log()? + size)?.affine(-2.0, 2.0 * 2f64.ln())?;
    let half_log_2_pi = 0.5 * (2.0 * std::f64::consts::PI).ln();
    let normal = noise.sqr()?.affine(-0.5, -half_log_2_pi)?.broadcast_sub(log_std)?;
    (normal - jacobian)?.sum(candle_core::D::Minus1)
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests;
