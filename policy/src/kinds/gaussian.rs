//! The Gaussian policy, which acts by its mode, tanh of a network of the state. If it has a
//! distribution, it explores by draws from it.

use crate::error::{Result, check_dims, check_numbers};
use crate::kinds::actor_critic::ACTOR;
use crate::policy::Policy;
use crate::sampling::episode::EpisodeState;
use candle_core::{Device, Tensor};
use quad_nn::{
    Ensemble, EnsembleShape, Init, Layout, MlpConfig, Precision, TensorSpec, Tensors, Weighted,
    f32_bytes, read, take,
};
use serde::{Deserialize, Serialize};

/// Name of log σ, `[a]`, of [`Spread::Shared`].
const LOG_STD: &str = "log_std";

/// Distribution of a Gaussian policy's actions around its mode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Spread {
    /// No distribution: the policy always takes its mode.
    #[default]
    None,
    /// Normal with the mode as its mean and the same σ in all states, clipped to ±1.
    Shared,
    /// tanh(u) of a normal u. The network returns its mean, then its log σ, which is clipped to
    /// −20 … 2.
    Squashed,
}

impl Spread {
    fn is_none(&self) -> bool {
        *self == Self::None
    }
}

/// The shape of a Gaussian policy's network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GaussianShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// The actor's hidden layers.
    pub actor: MlpConfig,
    /// Distribution of actions.
    #[serde(default, skip_serializing_if = "Spread::is_none")]
    pub spread: Spread,
}

impl GaussianShape {
    /// Shape of the actor. The tanh of its first a outputs is the mode.
    pub fn actor(&self) -> EnsembleShape {
        let outputs = match self.spread {
            Spread::Squashed => 2 * self.action_dim,
            _ => self.action_dim,
        };
        EnsembleShape::state_network(self.observation_dim, &self.actor, outputs)
    }

    /// Layout of log σ, `[a]`, of [`Spread::Shared`].
    pub(crate) fn log_std(&self) -> Option<Layout> {
        let spec = || TensorSpec::new(LOG_STD.to_owned(), &[self.action_dim], Init::Constant(0.0));
        (self.spread == Spread::Shared).then(|| Layout::new(vec![spec()]))
    }
}

/// A policy that acts by the mode.
pub struct GaussianPolicy {
    shape: GaussianShape,
    actor: Ensemble,
    /// log σ, `[a]`, of [`Spread::Shared`].
    log_std: Option<Tensor>,
}

/// The mean actions, `[n, a]` in (−1, 1), for `observations [n, o]`.
pub fn gaussian_mean(actor: &Ensemble, observations: &Tensor) -> candle_core::Result<Tensor> {
    actor.state_outputs(observations)?.squeeze(0)?.tanh()
}

impl GaussianPolicy {
    /// Bounds of log σ in [`Spread::Squashed`].
    pub const LOG_STD: (f32, f32) = (-20.0, 2.0);

    /// The tensors of a policy's file; `log_std`, `[a]`, is of [`Spread::Shared`].
    pub fn tensors(actor: &Ensemble, log_std: Option<Tensor>) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(log_std.map(|log_std| (LOG_STD.to_owned(), log_std)));
        Ok(tensors)
    }

    pub(crate) fn load(shape: GaussianShape, tensors: &mut Tensors) -> Result<Self> {
        check_dims(shape.observation_dim, shape.action_dim)?;
        let actor = Ensemble::take(shape.actor(), tensors, ACTOR, Precision::F32)?;
        let log_std = shape.log_std();
        let log_std = log_std.map(|_| take(tensors, LOG_STD.to_owned(), &[shape.action_dim]));
        Ok(Self { log_std: log_std.transpose()?, shape, actor })
    }

    /// Writes the modes of n states or, with standard normal `noise [n, a]`, draws from the
    /// distribution.
    fn write(
        &self,
        observations: &[f32],
        noise: Option<Tensor>,
        actions: &mut [f32],
    ) -> Result<()> {
        let (o, a) = (self.shape.observation_dim, self.shape.action_dim);
        let shape = (observations.len() / o, o);
        let observations = Tensor::from_slice(observations, shape, &Device::Cpu)?;
        let out = self.actor.state_outputs(&observations)?.squeeze(0)?;
        let mean = out.narrow(1, 0, a)?;
        let drawn = match (noise, &self.log_std) {
            (Some(noise), _) if self.shape.spread == Spread::Squashed => {
                let (least, most) = Self::LOG_STD;
                let std = out.narrow(1, a, a)?.clamp(least, most)?.exp()?;
                (mean + (noise * std)?)?.tanh()?
            }
            (Some(noise), Some(log_std)) => {
                let noise = noise.broadcast_mul(&log_std.exp()?)?;
                (mean.tanh()? + noise)?.clamp(-1f32, 1f32)?
            }
            _ => mean.tanh()?,
        };
        read(&drawn, |drawn: &[f32]| actions.copy_from_slice(drawn))?;
        check_numbers("an action", actions)
    }
}

impl Policy for GaussianPolicy {
    fn observation_dim(&self) -> usize {
        self.shape.observation_dim
    }

    fn action_dim(&self) -> usize {
        self.shape.action_dim
    }

    fn precision(&self) -> Precision {
        Precision::F32
    }

    fn memory(&self, states: usize) -> u64 {
        let states = states as u128;
        // Actions, and what exploring draws: noise, σ and their product.
        let numbers = states * (self.observation_dim() + 6 * self.action_dim()) as u128;
        f32_bytes(self.shape.actor().floats(states, 1) + numbers)
    }

    fn act(&self, observations: &[f32], _: &mut [EpisodeState], actions: &mut [f32]) -> Result<()> {
        self.write(observations, None, actions)
    }

    fn explore(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        let a = self.shape.action_dim;
        let mut noise = vec![0.0; states.len() * a];
        for (noise, state) in noise.chunks_exact_mut(a).zip(&mut *states) {
            state.fill_normal(noise);
        }
        let noise = Tensor::from_vec(noise, (states.len(), a), &Device::Cpu)?;
        self.write(observations, Some(noise), actions)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::file::PolicyConfig;
    use crate::testing::{act, load, two_units, with_weights};

    /// A policy of one number with the mean s/2 before the tanh. log σ is −1, or s.
    fn policy(spread: Spread) -> Box<dyn Policy> {
        let actor = two_units(1).actor;
        let (observation_dim, action_dim) = (1, 1);
        let shape = GaussianShape { observation_dim, action_dim, actor, spread };
        // relu(x) − relu(−x) = x.
        let first = [1.0, -1.0, 0.0, 0.0];
        let (last, log_std): (&[f32], _) = match spread {
            Spread::Squashed => (&[0.5, 1.0, -0.5, -1.0, 0.0, 0.0], vec![]),
            _ => (&[0.5, -0.5, 0.0], vec![-1.0]),
        };
        let weights = vec![[&first[..], last].concat(), log_std];
        load(&with_weights(PolicyConfig::Gaussian { shape }, weights)).unwrap()
    }

    fn explored(policy: &dyn Policy, state: f32, noise: f32) -> f32 {
        let (mut states, mut action) = ([EpisodeState::with_noise(vec![noise])], [0.0]);
        policy.explore(&[state], &mut states, &mut action).unwrap();
        action[0]
    }

    #[test]
    fn exploring_draws_from_the_distribution_around_the_mode() {
        let mode = 0.25f32.tanh();
        let shared = mode + 0.4 * (-1f32).exp();
        let squashed = |noise: f32| (0.25 + noise * 0.5f32.exp()).tanh();
        // log σ is at most 2.
        let clipped = (20.0 - 2.75 * 2f32.exp()).tanh();
        for (spread, state, noise, expected) in [
            (Spread::None, 0.5, 9.0, mode),
            (Spread::Shared, 0.5, 0.4, shared),
            (Spread::Shared, 0.5, 9.0, 1.0),
            (Spread::Shared, 0.5, -9.0, -1.0),
            (Spread::Squashed, 0.5, 0.4, squashed(0.4)),
            (Spread::Squashed, 0.5, 9.0, squashed(9.0)),
            (Spread::Squashed, 40.0, -2.75, clipped),
        ] {
            let policy = policy(spread);
            let taken = act(&*policy, &[0.5], &[1]).unwrap()[0];
            let action = explored(&*policy, state, noise);
            let error = (taken - mode).abs().max((action - expected).abs());
            assert!(error < 1e-5, "{spread:?}: {action} for {expected}");
        }
    }
}
