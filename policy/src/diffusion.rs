//! The diffusion policy: it draws candidates from the target actor, of which it takes one by what the target critics say of
//! them, the best if nothing else is asked for (Eq. 25).

use crate::choice::{Choice, Rule};
use crate::ensemble::Ensemble;
use crate::episode::EpisodeState;
use crate::error::{MOST, PolicyError, check_range};
use crate::mlp_config::MlpConfig;
use crate::noise_predictor::NoisePredictor;
use crate::policy::Policy;
use crate::precision::Precision;
use crate::schedule::Reverse;
use crate::shape::{EnsembleShape, NoiseShape, bytes, tile_numbers};
use crate::slices::read;
use crate::weights::{Tensors, Weights};
use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};

/// Most denoising steps that are believed; the tensors' shapes do not bound them.
const MOST_STEPS: usize = 1000;
/// Before the names of the networks' tensors.
const ACTOR: &str = "actor.";
const CRITIC: &str = "critic.";
const VALUE: &str = "value.";

/// The shapes of a diffusion policy's networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
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
            value: None,
            critics,
            diffusion_steps,
            reverse: Reverse::ClipClean,
        }
    }

    /// Of the noise predictor.
    pub fn actor(&self) -> NoiseShape {
        let Self { observation_dim, action_dim, diffusion_steps, reverse, .. } = *self;
        NoiseShape { observation_dim, action_dim, layers: self.actor.clone(), diffusion_steps, reverse }
    }

    /// Of the critics.
    pub fn critics(&self) -> EnsembleShape {
        let Self { observation_dim, action_dim, critics, .. } = *self;
        EnsembleShape { members: critics, observation_dim, action_dim, layers: self.critic.clone(), outputs: 1 }
    }

    /// Of the value function, if there is one.
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
    actor: NoisePredictor,
    critics: Ensemble,
    value: Option<Ensemble>,
    precision: Precision,
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
        let actor = NoisePredictor::new(shape.actor(), weights, precision);
        let mut ensemble = |of: EnsembleShape, prefix| -> Result<Ensemble, PolicyError> {
            let weights = Weights::take(of.layout(), tensors, prefix)?;
            Ok(Ensemble::new(of, weights, precision))
        };
        let critics = ensemble(shape.critics(), CRITIC)?;
        let value = shape.value().map(|of| ensemble(of, VALUE)).transpose()?;
        let mut policy = Self { shape, choice, actor, critics, value, precision };
        policy.choose(choice)?;
        Ok(policy)
    }

    /// Draws candidates with noise `T × states × candidates × action_dim`. Gives these, `states × candidates × action_dim`,
    /// and what the choice's rule compares of each, `states × candidates`: zeros where there is nothing to choose.
    pub(crate) fn draw(&self, observations: &[f32], noise: Vec<f32>) -> Result<(Vec<f32>, Vec<f32>), PolicyError> {
        let DiffusionShape { observation_dim, action_dim, diffusion_steps, .. } = self.shape;
        let (states, candidates) = (observations.len() / observation_dim, self.choice.candidates as usize);
        let rows = states * candidates;
        let observations = Tensor::from_slice(observations, (states, observation_dim), &Device::Cpu)?;
        let noise = Tensor::from_vec(noise, (diffusion_steps, rows, action_dim), &Device::Cpu)?;
        let drawn = self.actor.sample(&observations, &noise)?;
        let worth = match candidates {
            1 => vec![0.0; rows],
            _ => self.worth(&observations, &drawn)?,
        };
        Ok((read(&drawn, <[f32]>::to_vec)?, worth))
    }

    /// What the choice's rule compares of each of some actions.
    fn worth(&self, observations: &Tensor, actions: &Tensor) -> Result<Vec<f32>, PolicyError> {
        let rows = actions.dim(0)?;
        let values = self.critics.values(observations, actions)?;
        let mut worth = read(&values, |values: &[f32]| self.choice.value.reduce(values, rows))?;
        if let (Rule::Nearest, Some(value)) = (self.choice.rule, &self.value) {
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

    fn choose(&mut self, choice: Choice) -> Result<(), PolicyError> {
        choice.check()?;
        if choice.rule == Rule::Nearest && self.value.is_none() {
            return Err(PolicyError::NoValue);
        }
        self.choice = choice;
        Ok(())
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
        let DiffusionShape { action_dim, diffusion_steps, .. } = self.shape;
        let (n, candidates) = (states.len(), self.choice.candidates as usize);
        let row = candidates * action_dim;
        let mut noise = vec![0.0; diffusion_steps * n * row];
        for (i, state) in states.iter_mut().enumerate() {
            for step in 0..diffusion_steps {
                state.fill_normal(&mut noise[(step * n + i) * row..][..row]);
            }
        }
        let (drawn, worth) = self.draw(observations, noise)?;
        let of_each = drawn.chunks_exact(row).zip(worth.chunks_exact(candidates)).zip(states);
        for (action, ((drawn, worth), state)) in actions.chunks_exact_mut(action_dim).zip(of_each) {
            let chosen = self.choice.pick(worth, state)?;
            action.copy_from_slice(&drawn[chosen * action_dim..][..action_dim]);
        }
        match actions.iter().any(|x| x.is_nan()) {
            true => Err(PolicyError::NotANumber("a sampled action")),
            false => Ok(()),
        }
    }
}
