//! Policies of an actor network that draws candidates, and critics.

use crate::error::{Result, check_dims, check_range};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use quad_nn::{Ensemble, EnsembleShape, MAX_DIM, MlpConfig, Precision, Tensors, Weighted};
use serde::{Deserialize, Serialize};

/// Prefixes of the tensors' names.
pub(crate) const ACTOR: &str = "actor.";
pub(crate) const CRITIC: &str = "critic.";

/// The shapes of the networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActorCriticShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// The actor's hidden layers.
    pub actor: MlpConfig,
    /// The critics' hidden layers.
    pub critic: MlpConfig,
    /// Number of critics, K.
    pub critics: usize,
}

impl ActorCriticShape {
    /// Shape of the critics.
    pub fn critics(&self) -> EnsembleShape {
        let dims = (self.observation_dim, self.action_dim);
        EnsembleShape::critics(self.critics, dims, &self.critic)
    }

    /// The shape of a policy of these networks, and the tensors of its file.
    pub fn from_networks(
        actor: &Ensemble,
        critics: &Ensemble,
    ) -> candle_core::Result<(Self, Tensors)> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(critics.weights().tensors(CRITIC)?);
        let shape = critics.shape();
        let shape = Self {
            observation_dim: shape.observation_dim,
            action_dim: shape.action_dim,
            actor: actor.shape().layers.clone(),
            critic: shape.layers.clone(),
            critics: shape.members,
        };
        Ok((shape, tensors))
    }

    /// Loads a policy, removing its tensors from `tensors`.
    pub(crate) fn load<A: Actor + 'static>(
        &self,
        actor_shape: EnsembleShape,
        actor: impl FnOnce(Ensemble) -> A,
        choice: Choice,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<CandidatePolicy> {
        check_dims(self.observation_dim, self.action_dim)?;
        check_range("critics", self.critics, MAX_DIM)?;
        let actor = actor(Ensemble::take(actor_shape, tensors, ACTOR, precision)?);
        let networks = Networks {
            actor: Box::new(actor),
            critics: Some(Ensemble::take(self.critics(), tensors, CRITIC, precision)?),
            value: None,
            precision,
        };
        CandidatePolicy::new(networks.into(), choice)
    }
}
