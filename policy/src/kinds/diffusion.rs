//! The diffusion policy: candidates of the target actor, chosen by the target critics (Eq. 25).

use crate::error::{Result, check_dims, check_range};
use crate::kinds::actor_critic::{ACTOR, CRITIC};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use candle_core::Tensor;
use quad_nn::{
    Ensemble, EnsembleShape, MAX_DIM, MlpConfig, NoisePredictor, NoiseShape, Precision, Reverse,
    Tensors, Weighted, Weights, tile_floats,
};
use serde::{Deserialize, Serialize};

/// Largest number of denoising steps, which the tensors' shapes do not bound.
const MOST_STEPS: usize = 1000;
/// Prefix of the value function's tensors.
pub(crate) const VALUE: &str = "value.";

/// The shapes of the networks.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffusionShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// The noise predictor's hidden layers.
    pub actor: MlpConfig,
    /// The critics' hidden layers.
    pub critic: MlpConfig,
    /// The value function's hidden layers, for the rule `nearest`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<MlpConfig>,
    /// Number of critics, K; 0 for a policy that takes what it draws.
    pub critics: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// Formula of a reverse step.
    #[serde(default)]
    pub reverse: Reverse,
}

impl DiffusionShape {
    /// QUAD's networks: actor and critics with the same hidden layers.
    pub fn quad(dims: (usize, usize), layers: &MlpConfig, critics: usize, steps: usize) -> Self {
        Self {
            observation_dim: dims.0,
            action_dim: dims.1,
            actor: layers.clone(),
            critic: layers.clone(),
            critics,
            diffusion_steps: steps,
            ..Self::default()
        }
    }

    /// Shape of the noise predictor.
    pub fn actor(&self) -> NoiseShape {
        NoiseShape {
            observation_dim: self.observation_dim,
            action_dim: self.action_dim,
            layers: self.actor.clone(),
            diffusion_steps: self.diffusion_steps,
            reverse: self.reverse,
        }
    }

    /// Shape of the critics.
    pub fn critics(&self) -> EnsembleShape {
        let dims = (self.observation_dim, self.action_dim);
        EnsembleShape::critics(self.critics, dims, &self.critic)
    }

    /// Shape of the value function.
    pub fn value(&self) -> Option<EnsembleShape> {
        let layers = self.value.as_ref()?;
        Some(EnsembleShape::state_network(self.observation_dim, layers, 1))
    }
}

/// The diffusion policy.
pub struct DiffusionPolicy;

impl DiffusionPolicy {
    /// The tensors of a policy's file.
    pub fn tensors(
        actor: &NoisePredictor,
        critics: Option<&Ensemble>,
        value: Option<&Ensemble>,
    ) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        if let Some(critics) = critics {
            tensors.extend(critics.weights().tensors(CRITIC)?);
        }
        if let Some(value) = value {
            tensors.extend(value.weights().tensors(VALUE)?);
        }
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: &DiffusionShape,
        choice: Choice,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<CandidatePolicy> {
        check_dims(shape.observation_dim, shape.action_dim)?;
        check_range("critics", shape.critics.max(1), MAX_DIM)?;
        check_range("diffusion_steps", shape.diffusion_steps, MOST_STEPS)?;
        let weights = Weights::take(shape.actor().layout(), tensors, ACTOR)?;
        let actor = NoisePredictor::new(shape.actor(), weights, precision).packed()?;
        let actor = Box::new(actor);
        let critics = || Ensemble::take(shape.critics(), tensors, CRITIC, precision);
        let critics = (shape.critics > 0).then(critics).transpose()?;
        let value = |shape| Ensemble::take(shape, tensors, VALUE, precision);
        let value = shape.value().map(value).transpose()?;
        let networks = Networks { actor, critics, value, precision };
        CandidatePolicy::new(networks.into(), choice)
    }
}

impl Actor for NoisePredictor {
    fn dims(&self) -> (usize, usize) {
        (self.shape().observation_dim, self.shape().action_dim)
    }

    fn noise_vectors(&self) -> usize {
        self.shape().diffusion_steps
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        self.sample(observations, noise)
    }

    fn noise_predictor(&self) -> Option<&NoisePredictor> {
        Some(self)
    }

    fn floats(&self, _: u128, candidates: u128) -> u128 {
        tile_floats(candidates, &self.shape().layers)
    }
}

#[cfg(test)]
mod tests;
