//! The diffusion policy: it draws candidates from the target actor, of which it takes one by what the target critics say of
//! them, the best if nothing else is asked for (Eq. 25).

use crate::choice::{Choice, Rule};
use crate::ensemble::Ensemble;
use crate::episode::EpisodeState;
use crate::error::{MOST, PolicyError, check_numbers, check_range};
use crate::mlp_config::MlpConfig;
use crate::noise_predictor::NoisePredictor;
use crate::policy::{Policy, Sampled};
use crate::precision::Precision;
use crate::schedule::Reverse;
use crate::shape::{EnsembleShape, NoiseShape, bytes, tile_numbers};
use crate::slices::read;
use crate::weighted::Weighted;
use crate::weights::{Tensors, Weights};
use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Most denoising steps that are believed; the tensors' shapes do not bound them.
const MOST_STEPS: usize = 1000;
/// Before the names of the networks' tensors.
const ACTOR: &str = "actor.";
const CRITIC: &str = "critic.";
const VALUE: &str = "value.";

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
    pub fn quad(dims: (usize, usize), layers: &MlpConfig, critics: usize, diffusion_steps: usize) -> Self {
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
        NoiseShape { observation_dim, action_dim, layers: self.actor.clone(), diffusion_steps, reverse }
    }

    /// Shape of the critics.
    pub fn critics(&self) -> EnsembleShape {
        let Self { observation_dim, action_dim, critics, .. } = *self;
        EnsembleShape { members: critics, observation_dim, action_dim, layers: self.critic.clone(), outputs: 1 }
    }

    /// Shape of the value function, if there is one.
    pub fn value(&self) -> Option<EnsembleShape> {
        let layers = self.value.clone()?;
        Some(EnsembleShape { members: 1, action_dim: 0, layers, ..self.critics() })
    }

    fn check(&self) -> Result<(), PolicyError> {
        check_range("observation_dim", self.observation_dim, MOST)?;
        check_range("action_dim", self.action_dim, MOST)?;
        check_range("critics", self.critics, MOST)?;
        check_range("diffusion_steps", self.diffusion_steps, MOST_STEPS)
    }
}

/// Target actor, target critics and, if the choice takes it, a value function.
pub struct DiffusionPolicy {
    shape: DiffusionShape,
    choice: Choice,
    /// Shared with those that choose in another way.
    networks: Arc<Networks>,
    precision: Precision,
}

struct Networks {
    actor: NoisePredictor,
    critics: Ensemble,
    value: Option<Ensemble>,
}

impl DiffusionPolicy {
    /// The tensors of a policy of these networks, as they are named in a file. There is a value function exactly if
    /// the shape says so.
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
    ) -> Result<Self, PolicyError> {
        shape.check()?;
        let weights = Weights::take(shape.actor().layout(), tensors, ACTOR)?;
        let actor = NoisePredictor::new(shape.actor(), weights, precision).packed()?;
        let mut ensemble = |of: EnsembleShape, prefix| -> Result<Ensemble, PolicyError> {
            let weights = Weights::take(of.layout(), tensors, prefix)?;
            Ok(Ensemble::new(of, weights, precision).packed()?)
        };
        let critics = ensemble(shape.critics(), CRITIC)?;
        let value = shape.value().map(|of| ensemble(of, VALUE)).transpose()?;
        Self { shape, choice, networks: Arc::new(Networks { actor, critics, value }), precision }.choosing(choice)
    }

    /// Makes a policy of the same networks that chooses by `choice`.
    fn choosing(&self, choice: Choice) -> Result<Self, PolicyError> {
        choice.check()?;
        if choice.rule == Rule::Nearest && self.networks.value.is_none() {
            return Err(PolicyError::NoValue);
        }
        let (shape, networks) = (self.shape.clone(), self.networks.clone());
        Ok(Self { shape, choice, networks, precision: self.precision })
    }

    /// The noise of all steps of all candidates, `T × states × candidates × action_dim`.
    fn noise(&self, states: &mut [EpisodeState]) -> Vec<f32> {
        let (n, row) = (states.len(), self.choice.candidates as usize * self.shape.action_dim);
        let mut noise = vec![0.0; self.shape.diffusion_steps * n * row];
        for (i, state) in states.iter_mut().enumerate() {
            for step in 0..self.shape.diffusion_steps {
                state.fill_normal(&mut noise[(step * n + i) * row..][..row]);
            }
        }
        noise
    }

    /// The observations, `[states, observation_dim]`, and the candidates that this noise leads to, `[states · candidates, action_dim]`.
    fn candidates(&self, observations: &[f32], noise: Vec<f32>) -> Result<(Tensor, Tensor), PolicyError> {
        let DiffusionShape { observation_dim, action_dim, diffusion_steps, .. } = self.shape;
        let states = observations.len() / observation_dim;
        let rows = states * self.choice.candidates as usize;
        let observations = Tensor::from_slice(observations, (states, observation_dim), &Device::Cpu)?;
        let noise = Tensor::from_vec(noise, (diffusion_steps, rows, action_dim), &Device::Cpu)?;
        let drawn = self.networks.actor.sample(&observations, &noise)?;
        Ok((observations, drawn))
    }

    /// What the critics say of each of some actions, by the choice's [`Reduce`](crate::choice::Reduce).
    fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<Vec<f32>, PolicyError> {
        let rows = actions.dim(0)?;
        let values = self.networks.critics.values(observations, actions)?;
        Ok(read(&values, |values: &[f32]| self.choice.value.reduce(values, rows))?)
    }

    /// Draws candidates with noise `T × states × candidates × action_dim`. Gives these, `states × candidates × action_dim`,
    /// and what the choice's rule compares of each, `states × candidates`: zeros where there is nothing to choose.
    pub(crate) fn draw(&self, observations: &[f32], noise: Vec<f32>) -> Result<(Vec<f32>, Vec<f32>), PolicyError> {
        let (observations, drawn) = self.candidates(observations, noise)?;
        let worth = match self.choice.candidates {
            1 => vec![0.0; drawn.dim(0)?],
            _ => self.worth(&observations, &drawn)?,
        };
        Ok((read(&drawn, <[f32]>::to_vec)?, worth))
    }

    /// What the choice's rule compares of each of some actions.
    fn worth(&self, observations: &Tensor, actions: &Tensor) -> Result<Vec<f32>, PolicyError> {
        let mut worth = self.values(observations, actions)?;
        if let (Rule::Nearest, Some(value)) = (self.choice.rule, &self.networks.value) {
            let of_states = read(&value.state_values(observations)?, <[f32]>::to_vec)?;
            for (of_one, v) in worth.chunks_exact_mut(self.choice.candidates as usize).zip(of_states) {
                of_one.iter_mut().for_each(|q| *q = -(*q - v).powi(2));
            }
        }
        Ok(worth)
    }
}

impl Policy for DiffusionPolicy {
    fn observation_dim(&self) -> usize {
        self.shape.observation_dim
    }

    fn action_dim(&self) -> usize {
        self.shape.action_dim
    }

    fn precision(&self) -> Precision {
        self.precision.in_effect()
    }

    fn choice(&self) -> Option<Choice> {
        Some(self.choice)
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>, PolicyError> {
        Ok(Box::new(self.choosing(choice)?))
    }

    fn memory(&self, states: usize) -> u64 {
        let DiffusionShape { observation_dim, action_dim, diffusion_steps, .. } = self.shape;
        let (states, candidates) = (states as u128, u128::from(self.choice.candidates));
        // The noise of all steps, the candidates and their copies, and their values.
        let drawn = states * candidates * (action_dim * (diffusion_steps + 3) + 1) as u128;
        let sampling = drawn + states * observation_dim as u128 + tile_numbers(candidates, &self.shape.actor);
        let of_states = self.shape.value().map_or(0, |value| value.memory(states, 1));
        bytes(sampling + self.shape.critics().memory(states, candidates) + of_states)
    }

    fn act(&self, observations: &[f32], states: &mut [EpisodeState], actions: &mut [f32]) -> Result<(), PolicyError> {
        let (action_dim, candidates) = (self.shape.action_dim, self.choice.candidates as usize);
        let (drawn, worth) = self.draw(observations, self.noise(states))?;
        let of_each = drawn.chunks_exact(candidates * action_dim).zip(worth.chunks_exact(candidates)).zip(states);
        for (action, ((drawn, worth), state)) in actions.chunks_exact_mut(action_dim).zip(of_each) {
            let chosen = self.choice.pick(worth, state)?;
            action.copy_from_slice(&drawn[chosen * action_dim..][..action_dim]);
        }
        check_numbers("a sampled action", actions)
    }

    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Sampled, PolicyError> {
        let (observations, drawn) = self.candidates(observations, self.noise(states))?;
        let values = self.values(&observations, &drawn)?;
        let actions = read(&drawn, <[f32]>::to_vec)?;
        check_numbers("a sampled action", &actions)?;
        check_numbers("the value of a candidate", &values)?;
        Ok(Sampled { actions, values })
    }

    fn value(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>, PolicyError> {
        let DiffusionShape { observation_dim, action_dim, .. } = self.shape;
        let n = actions.len() / action_dim;
        let observations = Tensor::from_slice(observations, (n, observation_dim), &Device::Cpu)?;
        let actions = Tensor::from_slice(actions, (n, action_dim), &Device::Cpu)?;
        let values = self.values(&observations, &actions)?;
        check_numbers("the value of an action", &values)?;
        Ok(values)
    }
}
