//! Policies that draw candidates with noise and choose among them by what critics say, whatever it
//! is that draws.

use crate::error::{PolicyError, check_numbers};
use crate::policy::{Policy, Sampled};
use crate::sampling::choice::{Choice, Rule};
use crate::sampling::episode::EpisodeState;
use candle_core::{Device, Tensor};
use quad_nn::{Ensemble, Precision, bytes, read};
use std::sync::Arc;

/// What draws actions.
pub(crate) trait Actor: Send + Sync {
    /// Numbers in an observation and in an action.
    fn dims(&self) -> (usize, usize);

    /// How many vectors of noise, each as long as an action, one action takes.
    fn noises(&self) -> usize;

    /// Draws actions `[rows, a]` in the states of `observations`, `[n, o]`, with standard normal
    /// `noise`, `[noises, rows, a]`; equally many consecutive rows share a state.
    fn draw(&self, observations: &Tensor, noise: &Tensor) -> candle_core::Result<Tensor>;

    /// Numbers that drawing so many actions in each of some states takes beside the noise and the
    /// actions.
    fn memory(&self, states: u128, candidates: u128) -> u128;
}

/// The networks of such a policy.
pub(crate) struct Networks {
    pub actor: Box<dyn Actor>,
    pub critics: Ensemble,
    /// What the rule `nearest` takes.
    pub value: Option<Ensemble>,
}

/// A policy of such networks.
pub(crate) struct CandidatePolicy {
    choice: Choice,
    /// Shared with those that choose in another way.
    networks: Arc<Networks>,
    precision: Precision,
}

impl CandidatePolicy {
    pub fn new(
        networks: Networks,
        choice: Choice,
        precision: Precision,
    ) -> Result<Self, PolicyError> {
        Self { choice, networks: Arc::new(networks), precision }.choosing(choice)
    }

    /// Makes a policy of the same networks that chooses by `choice`.
    fn choosing(&self, choice: Choice) -> Result<Self, PolicyError> {
        choice.check()?;
        if choice.rule == Rule::Nearest && self.networks.value.is_none() {
            return Err(PolicyError::NoValue);
        }
        Ok(Self { choice, networks: self.networks.clone(), precision: self.precision })
    }

    /// The noise of all candidates, `noises × states × candidates × action_dim`.
    fn drawn(&self, states: &mut [EpisodeState]) -> Vec<f32> {
        let (n, row) = (states.len(), self.choice.candidates as usize * self.action_dim());
        let noises = self.networks.actor.noises();
        let mut noise = vec![0.0; noises * n * row];
        for (i, state) in states.iter_mut().enumerate() {
            for number in 0..noises {
                state.fill_normal(&mut noise[(number * n + i) * row..][..row]);
            }
        }
        noise
    }

    /// The observations, `[states, observation_dim]`, and the candidates that this noise leads to,
    /// `[states · candidates, action_dim]`.
    fn candidates(
        &self,
        observations: &[f32],
        noise: Vec<f32>,
    ) -> Result<(Tensor, Tensor), PolicyError> {
        let (observation_dim, action_dim) = self.networks.actor.dims();
        let states = observations.len() / observation_dim;
        let rows = states * self.choice.candidates as usize;
        let observations =
            Tensor::from_slice(observations, (states, observation_dim), &Device::Cpu)?;
        let noise = Tensor::from_vec(
            noise,
            (self.networks.actor.noises(), rows, action_dim),
            &Device::Cpu,
        )?;
        let drawn = self.networks.actor.draw(&observations, &noise)?;
        Ok((observations, drawn))
    }

    /// What the critics say of each of some actions, by the choice's
    /// [`Aggregate`](crate::sampling::choice::Aggregate).
    fn values(&self, observations: &Tensor, actions: &Tensor) -> Result<Vec<f32>, PolicyError> {
        let rows = actions.dim(0)?;
        let values = self.networks.critics.values(observations, actions)?;
        Ok(read(&values, |values: &[f32]| self.choice.value.reduce(values, rows))?)
    }

    /// Draws candidates with noise `noises × states × candidates × action_dim`. Gives these,
    /// `states × candidates × action_dim`, and what the choice's rule compares of each, `states ×
    /// candidates`: zeros where there is nothing to choose.
    pub fn draw(
        &self,
        observations: &[f32],
        noise: Vec<f32>,
    ) -> Result<(Vec<f32>, Vec<f32>), PolicyError> {
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
            for (of_one, v) in
                worth.chunks_exact_mut(self.choice.candidates as usize).zip(of_states)
            {
                of_one.iter_mut().for_each(|q| *q = -(*q - v).powi(2));
            }
        }
        Ok(worth)
    }
}

/// Writes the mean of the chosen ones among candidates.
fn mean_of(chosen: &[usize], drawn: &[f32], action: &mut [f32]) {
    let a = action.len();
    for (j, x) in action.iter_mut().enumerate() {
        *x = chosen.iter().map(|place| drawn[place * a + j]).sum::<f32>() / chosen.len() as f32;
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
        self.precision.in_effect()
    }

    fn choice(&self) -> Option<Choice> {
        Some(self.choice)
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>, PolicyError> {
        Ok(Box::new(self.choosing(choice)?))
    }

    fn memory(&self, states: usize) -> u64 {
        let Networks { actor, critics, value } = &*self.networks;
        let ((observation_dim, action_dim), noises) = (actor.dims(), actor.noises());
        let (states, candidates) = (states as u128, u128::from(self.choice.candidates));
        // The noise of all steps, the candidates and their copies, and their values.
        let drawn = states * candidates * (action_dim * (noises + 3) + 1) as u128;
        let sampling = drawn + states * observation_dim as u128 + actor.memory(states, candidates);
        let of_states = value.as_ref().map_or(0, |value| value.shape().memory(states, 1));
        bytes(sampling + critics.shape().memory(states, candidates) + of_states)
    }

    fn noise(&self) -> Vec<usize> {
        vec![self.networks.actor.noises(), self.choice.candidates as usize, self.action_dim()]
    }

    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<(), PolicyError> {
        let (action_dim, candidates) = (self.action_dim(), self.choice.candidates as usize);
        let (drawn, worth) = self.draw(observations, self.drawn(states))?;
        let of_each = drawn
            .chunks_exact(candidates * action_dim)
            .zip(worth.chunks_exact(candidates))
            .zip(states);
        for (action, ((drawn, worth), state)) in actions.chunks_exact_mut(action_dim).zip(of_each) {
            mean_of(&self.choice.pick(worth, state)?, drawn, action);
        }
        check_numbers("a sampled action", actions)
    }

    fn sample(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
    ) -> Result<Sampled, PolicyError> {
        let (observations, drawn) = self.candidates(observations, self.drawn(states))?;
        let values = self.values(&observations, &drawn)?;
        let actions = read(&drawn, <[f32]>::to_vec)?;
        check_numbers("a sampled action", &actions)?;
        check_numbers("the value of a candidate", &values)?;
        Ok(Sampled { actions, values })
    }

    fn value(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>, PolicyError> {
        let (observation_dim, action_dim) = self.networks.actor.dims();
        let n = actions.len() / action_dim;
        let observations = Tensor::from_slice(observations, (n, observation_dim), &Device::Cpu)?;
        let actions = Tensor::from_slice(actions, (n, action_dim), &Device::Cpu)?;
        let values = self.values(&observations, &actions)?;
        check_numbers("the value of an action", &values)?;
        Ok(values)
    }
}
