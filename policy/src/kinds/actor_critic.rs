//! Policies of a network that draws and of critics: the shapes of these, their tensors, and what
//! loads them.

use crate::error::{PolicyError, check_range};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use quad_nn::{Ensemble, EnsembleShape, MAX_DIM, MlpConfig, Precision, Tensors, Weighted};
use serde::{Deserialize, Serialize};

/// Before the names of the networks' tensors.
const ACTOR: &str = "actor.";
const CRITIC: &str = "critic.";

/// The shapes of such a policy's networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActorCriticShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// The hidden layers of the network that draws.
    pub actor: MlpConfig,
    /// The critics' hidden layers.
    pub critic: MlpConfig,
    /// Ensemble size K.
    pub critics: usize,
}

impl ActorCriticShape {
    /// Shape of the critics.
    pub fn critics(&self) -> EnsembleShape {
        let Self { observation_dim, action_dim, critics, .. } = *self;
        EnsembleShape {
            members: critics,
            observation_dim,
            action_dim,
            layers: self.critic.clone(),
            outputs: 1,
        }
    }

    /// The shape of a policy of these networks.
    pub fn of(actor: &Ensemble, critics: &Ensemble) -> Self {
        let EnsembleShape { members, observation_dim, action_dim, layers, .. } = critics.shape();
        Self {
            observation_dim: *observation_dim,
            action_dim: *action_dim,
            actor: actor.shape().layers.clone(),
            critic: layers.clone(),
            critics: *members,
        }
    }

    /// The tensors of a policy of these networks, as they are named in a file.
    ///
    /// # Errors
    /// Candle fails.
    pub fn tensors(actor: &Ensemble, critics: &Ensemble) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(critics.weights().tensors(CRITIC)?);
        Ok(tensors)
    }

    /// Takes the networks of a policy out of a file's tensors: one of the shape `of_actor`, of
    /// which `actor` makes what draws, and critics.
    pub(crate) fn load<A: Actor + 'static>(
        &self,
        of_actor: EnsembleShape,
        actor: fn(Ensemble) -> A,
        choice: Choice,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<CandidatePolicy, PolicyError> {
        check_range("observation_dim", self.observation_dim, MAX_DIM)?;
        check_range("action_dim", self.action_dim, MAX_DIM)?;
        check_range("critics", self.critics, MAX_DIM)?;
        let actor = Box::new(actor(Ensemble::take(of_actor, tensors, ACTOR, precision)?));
        let critics = Ensemble::take(self.critics(), tensors, CRITIC, precision)?;
        CandidatePolicy::new(Networks { actor, critics, value: None }, choice, precision)
    }
}
