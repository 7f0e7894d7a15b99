//! The Gaussian policy, which acts by its mean: tanh of a network of the state.

use crate::error::{Result, check_dims, check_numbers};
use crate::kinds::actor_critic::ACTOR;
use crate::policy::Policy;
use crate::sampling::episode::EpisodeState;
use candle_core::{Device, Tensor};
use quad_nn::{Ensemble, EnsembleShape, MlpConfig, Precision, Tensors, Weighted, bytes, read};
use serde::{Deserialize, Serialize};

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
}

impl GaussianShape {
    /// Shape of the actor, whose tanh is the mean.
    pub fn actor(&self) -> EnsembleShape {
        EnsembleShape::of_state(self.observation_dim, &self.actor, self.action_dim)
    }
}

/// A policy that acts by the mean.
pub struct GaussianPolicy {
    shape: GaussianShape,
    actor: Ensemble,
}

/// The mean actions, `[n, a]` in (−1, 1), for `observations [n, o]`.
pub fn gaussian_mean(actor: &Ensemble, observations: &Tensor) -> candle_core::Result<Tensor> {
    actor.state_outputs(observations)?.squeeze(0)?.tanh()
}

impl GaussianPolicy {
    /// The tensors of a policy's file.
    pub fn tensors(actor: &Ensemble) -> candle_core::Result<Tensors> {
        actor.weights().tensors(ACTOR)
    }

    pub(crate) fn load(shape: GaussianShape, tensors: &mut Tensors) -> Result<Self> {
        check_dims(shape.observation_dim, shape.action_dim)?;
        let actor = Ensemble::take(shape.actor(), tensors, ACTOR, Precision::F32)?;
        Ok(Self { shape, actor })
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
        let numbers = states * (self.observation_dim() + 2 * self.action_dim()) as u128;
        bytes(self.shape.actor().floats(states, 1) + numbers)
    }

    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        let shape = (states.len(), self.shape.observation_dim);
        let observations = Tensor::from_slice(observations, shape, &Device::Cpu)?;
        let means = gaussian_mean(&self.actor, &observations)?;
        read(&means, |means: &[f32]| actions.copy_from_slice(means))?;
        check_numbers("an action", actions)
    }
}
