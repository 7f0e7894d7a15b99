//! Policies of an actor that draws candidates, and critics that choose among them.

use crate::error::{PolicyError, Result, check_numbers};
use crate::policy::{Policy, Samples};
use crate::sampling::choice::{Choice, Rule};
use crate::sampling::episode::EpisodeState;
use candle_core::{Device, Tensor};
use quad_nn::{Ensemble, NoisePredictor, Precision, f32_bytes, read};
use std::sync::Arc;

/// Networks that draw candidates.
pub(crate) trait Actor: Send + Sync {
    /// Lengths of an observation and of an action.
    fn dims(&self) -> (usize, usize);

    /// Number of noise vectors, each as long as an action, for one action.
    fn noise_vectors(&self) -> usize {
        1
    }

    /// Draws actions `[rows, a]` for `observations`, `[n, o]`, from standard normal `noise`,
    /// `[noise vectors, rows, a]`. The first rows/n rows belong to the first observation, and so on.
    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor>;

    /// The noise predictor, if critics can guide it.
    fn noise_predictor(&self) -> Option<&NoisePredictor> {
        None
    }

    /// Numbers held while drawing this many candidates in each state, beside noise and candidates.
    fn floats(&self, states: u128, candidates: u128) -> u128;
}

/// The networks of a policy.
pub(crate) struct Networks {
    pub actor: Box<dyn Actor>,
    /// Without them a single candidate is drawn.
    pub critics: Option<Ensemble>,
    /// Value function of the rule `nearest`.
    pub value: Option<Ensemble>,
    pub precision: Precision,
}

/// A policy that chooses among candidates.
pub(crate) struct CandidatePolicy {
    choice: Choice,
    /// Shared with copies that have another choice.
    networks: Arc<Networks>,
}

impl CandidatePolicy {
    pub fn new(networks: Arc<Networks>, choice: Choice) -> Result<Self> {
        choice.check()?;
        if choice.rule == Rule::Nearest && networks.value.is_none() {
            return Err(PolicyError::NoValue);
        }
        let unvalued = Choice { guidance: choice.guidance, ..Choice::best_of(1) };
        if choice != unvalued && networks.critics.is_none() {
            return Err(PolicyError::NoCritics);
        }
        let policy = Self { choice, networks };
        if choice.guidance != 0.0 && policy.guided().is_none() {
            return Err(PolicyError::NoGuidance);
        }
        Ok(policy)
    }

    /// The noise predictor and the critics that guide it, if the choice wants it.
    fn guided(&self) -> Option<(&NoisePredictor, &Ensemble)> {
        let Networks { actor, critics, .. } = &*self.networks;
        let guided = actor.noise_predictor().zip(critics.as_ref());
        guided.filter(|_| self.choice.guidance != 0.0)
    }

    /// The observations, `[states, o]`, and candidates drawn for them, `[states·candidates, a]`.
    fn candidates(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
    ) -> Result<(Tensor, Tensor)> {
        let Networks { actor, .. } = &*self.networks;
        let ((observation_dim, action_dim), noises) = (actor.dims(), actor.noise_vectors());
        let (n, candidates) = (states.len(), self.choice.candidates as usize);
        let row = candidates * action_dim;
        let mut noise = vec![0.0; noises * n * row];
        for (i, state) in states.iter_mut().enumerate() {
            for number in 0..noises {
                state.fill_normal(&mut noise[(number * n + i) * row..][..row]);
            }
        }
        let observations = Tensor::from_slice(observations, (n, observation_dim), &Device::Cpu)?;
        let noise = Tensor::from_vec(noise, (noises, n * candidates, action_dim), &Device::Cpu)?;
        let drawn = match self.guided() {
            Some((actor, critics)) => {
                actor.sample_guided(&observations, &noise, critics, self.choice.guidance)?
            }
            None => actor.draw(&observations, &noise)?,
        };
        Ok((observations, drawn))
    }

    /// The critics' values of actions, by the choice's
    /// [`Aggregate`](crate::sampling::choice::Aggregate).
    fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<Vec<f32>> {
        let (critics, rows) = (self.networks.critics.as_ref(), actions.dim(0)?);
        let critics = critics.ok_or(PolicyError::NoCritics)?;
        let values = critics.values(observations, actions)?;
        Ok(read(&values, |values: &[f32]| self.choice.aggregate.reduce(values, rows))?)
    }

    /// The numbers that the choice's rule compares: values Q, or −(Q − V)² for the rule `nearest`.
    fn scores(&self, observations: &Tensor, actions: &Tensor) -> Result<Vec<f32>> {
        let mut scores = self.values(observations, actions)?;
        if let (Rule::Nearest, Some(value)) = (self.choice.rule, &self.networks.value) {
            let values = read(&value.state_values(observations)?, <[f32]>::to_vec)?;
            let candidates = scores.chunks_exact_mut(self.choice.candidates as usize);
            for (scores, v) in candidates.zip(values) {
                scores.iter_mut().for_each(|q| *q = -(*q - v).powi(2));
            }
        }
        Ok(scores)
    }
}

impl Policy for CandidatePolicy {
    fn observation_dim(&self) -> usize {
        self.networks.actor.dims().0
    }

    fn action_dim(&self) -> usize {
        self.networks.actor.dims().1
    }

    fn precision(&self) -> Precision {
        self.networks.precision.in_effect()
    }

    fn choice(&self) -> Option<Choice> {
        self.networks.critics.as_ref().map(|_| self.choice)
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>> {
        Ok(Box::new(Self::new(self.networks.clone(), choice)?))
    }

    fn memory(&self, states: usize) -> u64 {
        let Networks { actor, critics, value, .. } = &*self.networks;
        let ((observation_dim, action_dim), noises) = (actor.dims(), actor.noise_vectors());
        let (states, candidates) = (states as u128, u128::from(self.choice.candidates));
        // The noise of all steps, the candidates and their copies, and their values.
        let drawn = states * candidates * (action_dim * (noises + 3) + 1) as u128;
        let sampling = drawn + states * observation_dim as u128 + actor.floats(states, candidates);
        let floats = |ensemble: &Option<Ensemble>, actions| {
            ensemble.as_ref().map_or(0, |ensemble| ensemble.shape().floats(states, actions))
        };
        let valuing = floats(critics, candidates) + floats(value, 1);
        let guiding = self
            .guided()
            .map_or(0, |(actor, critics)| actor.guided_floats(states * candidates, critics));
        f32_bytes(sampling + valuing + guiding)
    }

    fn noise(&self) -> Vec<usize> {
        let noises = self.networks.actor.noise_vectors();
        vec![noises, self.choice.candidates as usize, self.action_dim()]
    }

    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        let (observations, drawn) = self.candidates(observations, states)?;
        let scores = match self.choice.candidates {
            1 => vec![0.0; states.len()], // not compared
            _ => self.scores(&observations, &drawn)?,
        };
        let drawn = read(&drawn, <[f32]>::to_vec)?;
        self.choice.take(&drawn, &scores, states, actions)?;
        check_numbers("a sampled action", actions)
    }

    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Samples> {
        let (observations, drawn) = self.candidates(observations, states)?;
        let values = self.values(&observations, &drawn)?;
        let actions = read(&drawn, <[f32]>::to_vec)?;
        check_numbers("a sampled action", &actions)?;
        check_numbers("the value of a candidate", &values)?;
        Ok(Samples { actions, values })
    }

    fn value(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>> {
        let (observation_dim, action_dim) = self.networks.actor.dims();
        let n = actions.len() / action_dim;
        let observations = Tensor::from_slice(observations, (n, observation_dim), &Device::Cpu)?;
        let actions = Tensor::from_slice(actions, (n, action_dim), &Device::Cpu)?;
        let values = self.values(&observations, &actions)?;
        check_numbers("the value of an action", &values)?;
        Ok(values)
    }
}
