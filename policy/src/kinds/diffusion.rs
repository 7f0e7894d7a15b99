//! The diffusion policy: it draws candidates from the target actor, of which it takes one by what
//! the target critics say of them, the best if nothing else is asked for (Eq. 25).

use crate::error::{PolicyError, check_range};
use crate::sampling::candidates::{Actor, CandidatePolicy, Networks};
use crate::sampling::choice::Choice;
use candle_core::Tensor;
use quad_nn::{
    Ensemble, EnsembleShape, MAX_DIM, MlpConfig, NoisePredictor, NoiseShape, Precision, Reverse,
    Tensors, Weighted, Weights, tile_numbers,
};
use serde::{Deserialize, Serialize};

/// Most denoising steps that are believed; the tensors' shapes do not bound them.
const MOST_STEPS: usize = 1000;
/// Before the names of the networks' tensors.
pub(crate) const ACTOR: &str = "actor.";
pub(crate) const CRITIC: &str = "critic.";
pub(crate) const VALUE: &str = "value.";

/// The shapes of a diffusion policy's networks.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffusionShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// The noise predictor's hidden layers.
    pub actor: MlpConfig,
    /// The critics' hidden layers.
    pub critic: MlpConfig,
    /// The value function's, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<MlpConfig>,
    /// Ensemble size K.
    pub critics: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// How each of them is made when sampling.
    #[serde(default)]
    pub reverse: Reverse,
}

impl DiffusionShape {
    /// QUAD's: noise predictor and critics with the same hidden layers.
    pub fn quad(
        dims: (usize, usize),
        layers: &MlpConfig,
        critics: usize,
        diffusion_steps: usize,
    ) -> Self {
        Self {
            observation_dim: dims.0,
            action_dim: dims.1,
            actor: layers.clone(),
            critic: layers.clone(),
            critics,
            diffusion_steps,
            ..Self::default()
        }
    }

    /// Shape of the noise predictor.
    pub fn actor(&self) -> NoiseShape {
        let Self { observation_dim, action_dim, diffusion_steps, reverse, .. } = *self;
        NoiseShape {
            observation_dim,
            action_dim,
            layers: self.actor.clone(),
            diffusion_steps,
            reverse,
        }
    }

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

    /// Shape of the value function, if there is one.
    pub fn value(&self) -> Option<EnsembleShape> {
        let layers = self.value.clone()?;
        Some(EnsembleShape { members: 1, action_dim: 0, layers, ..self.critics() })
    }

    fn check(&self) -> Result<(), PolicyError> {
        check_range("observation_dim", self.observation_dim, MAX_DIM)?;
        check_range("action_dim", self.action_dim, MAX_DIM)?;
        check_range("critics", self.critics, MAX_DIM)?;
        check_range("diffusion_steps", self.diffusion_steps, MOST_STEPS)
    }
}

/// The diffusion policy, of target actor, target critics and, if the choice takes it, a value
/// function.
pub struct DiffusionPolicy;

impl DiffusionPolicy {
    /// The tensors of a policy of these networks, as they are named in a file. There is a value
    /// function exactly if the shape says so.
    pub fn tensors(
        actor: &NoisePredictor,
        critics: &Ensemble,
        value: Option<&Ensemble>,
    ) -> candle_core::Result<Tensors> {
        let mut tensors = actor.weights().tensors(ACTOR)?;
        tensors.extend(critics.weights().tensors(CRITIC)?);
        if let Some(value) = value {
            tensors.extend(value.weights().tensors(VALUE)?);
        }
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: DiffusionShape,
        choice: Choice,
        tensors: &mut Tensors,
        precision: Precision,
    ) -> Result<CandidatePolicy, PolicyError> {
        shape.check()?;
        let weights = Weights::take(shape.actor().layout(), tensors, ACTOR)?;
        let actor = NoisePredictor::new(shape.actor(), weights, precision).packed()?;
        let critics = Ensemble::take(shape.critics(), tensors, CRITIC, precision)?;
        let value =
            shape.value().map(|of| Ensemble::take(of, tensors, VALUE, precision)).transpose()?;
        CandidatePolicy::new(Networks { actor: Box::new(actor), critics, value }, choice, precision)
    }
}

impl Actor for NoisePredictor {
    fn dims(&self) -> (usize, usize) {
        (self.shape().observation_dim, self.shape().action_dim)
    }

    fn noises(&self) -> usize {
        self.shape().diffusion_steps
    }

    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor> {
        self.sample(observations, noise)
    }

    fn memory(&self, _: u128, candidates: u128) -> u128 {
        tile_numbers(candidates, &self.shape().layers)
    }
}
