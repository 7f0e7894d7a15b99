//! Policies that act for several steps at a time.

use crate::error::{PolicyError, Result, check_range};
use crate::policy::{Policy, Samples};
use crate::sampling::choice::Choice;
use crate::sampling::episode::EpisodeState;
use quad_nn::{Precision, f32_bytes};
use serde::{Deserialize, Serialize};
use std::mem;

/// Chunks of actions, which the networks know as one action each, and the last observations, which
/// they know as one observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Chunk {
    /// Number of last observations that a chunk is drawn from, oldest first. An episode's first
    /// observation stands for those before it.
    pub history: usize,
    /// Steps h of a chunk; 1 is a single action.
    pub length: usize,
    /// Steps ≤ h that are executed before the next chunk is drawn.
    pub replan: usize,
}

impl Default for Chunk {
    fn default() -> Self {
        Self { history: 1, length: 1, replan: 1 }
    }
}

impl Chunk {
    pub(crate) fn is_single(&self) -> bool {
        self.length == 1 && self.history == 1
    }
}

/// Executes the chunks that a policy draws.
struct Chunked {
    /// The policy whose actions are chunks, h·a.
    policy: Box<dyn Policy>,
    chunk: Chunk,
}

/// The policy that executes the chunks of `policy`.
pub(crate) fn chunked(policy: Box<dyn Policy>, chunk: Chunk) -> Result<Box<dyn Policy>> {
    if chunk.is_single() {
        return Ok(policy);
    }
    for (field, value, width) in [
        ("chunk.history", chunk.history, policy.observation_dim()),
        ("chunk.length", chunk.length, policy.action_dim()),
    ] {
        check_range(field, value, width)?;
        if !width.is_multiple_of(value) {
            return Err(PolicyError::Range { field, value });
        }
    }
    check_range("chunk.replan", chunk.replan, chunk.length)?;
    Ok(Box::new(Chunked { policy, chunk }))
}

impl Chunked {
    /// Takes the next action of each state's chunk; `draw` acts in the states that have none left.
    fn execute(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
        draw: impl FnOnce(&[f32], &mut [EpisodeState], &mut [f32]) -> Result<()>,
    ) -> Result<()> {
        let (a, width) = (self.action_dim(), self.policy.action_dim());
        self.observe(observations, states);
        let mut places = Vec::from_iter(0..states.len());
        places.retain(|place| states[*place].chunk.is_empty());
        if !places.is_empty() {
            let seen = places.iter().flat_map(|place| &states[*place].seen);
            let observations = Vec::from_iter(seen.copied());
            let take = |place: &usize| mem::replace(&mut states[*place], EpisodeState::new(0));
            let mut drawing = Vec::from_iter(places.iter().map(take));
            let mut chunks = vec![0.0; places.len() * width];
            let drawn = draw(&observations, &mut drawing, &mut chunks);
            places.iter().zip(drawing).for_each(|(place, state)| states[*place] = state);
            drawn?;
            for (place, chunk) in places.into_iter().zip(chunks.chunks_exact(width)) {
                states[place].chunk.extend(&chunk[..self.chunk.replan * a]);
            }
        }
        for (action, state) in actions.chunks_exact_mut(a).zip(states) {
            action.iter_mut().zip(state.chunk.drain(..a)).for_each(|(x, next)| *x = next);
        }
        Ok(())
    }
}

impl Policy for Chunked {
    fn observation_dim(&self) -> usize {
        self.policy.observation_dim() / self.chunk.history
    }

    fn action_dim(&self) -> usize {
        self.policy.action_dim() / self.chunk.length
    }

    fn precision(&self) -> Precision {
        self.policy.precision()
    }

    fn choice(&self) -> Option<Choice> {
        self.policy.choice()
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>> {
        Ok(Box::new(Self { policy: self.policy.with_choice(choice)?, chunk: self.chunk }))
    }

    fn memory(&self, states: usize) -> u64 {
        let own = states * 2 * (self.policy.observation_dim() + self.policy.action_dim());
        let moved = states * (size_of::<EpisodeState>() + size_of::<usize>());
        self.policy.memory(states).saturating_add(f32_bytes(own as u128) + moved as u64)
    }

    fn observe(&self, observations: &[f32], states: &mut [EpisodeState]) {
        for (observation, state) in observations.chunks(self.observation_dim()).zip(states) {
            match state.seen.is_empty() {
                true => state.seen = observation.repeat(self.chunk.history),
                false => {
                    state.seen.drain(..observation.len());
                    state.seen.extend(observation);
                }
            }
        }
    }

    fn begin(&self, seed: u64) -> EpisodeState {
        self.policy.begin(seed)
    }

    fn noise(&self) -> Vec<usize> {
        self.policy.noise()
    }

    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        self.execute(observations, states, actions, |o, s, a| self.policy.act(o, s, a))
    }

    fn explore(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        self.execute(observations, states, actions, |o, s, a| self.policy.explore(o, s, a))
    }

    /// The first action and the value of each chunk that is drawn, in states without one.
    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Samples> {
        self.observe(observations, states);
        let seen = Vec::from_iter(states.iter().flat_map(|state| &state.seen).copied());
        let Samples { actions, values } = self.policy.sample(&seen, states)?;
        let first = |chunk: &[f32]| chunk[..self.action_dim()].to_vec();
        let actions = actions.chunks_exact(self.policy.action_dim()).flat_map(first).collect();
        Ok(Samples { actions, values })
    }

    fn value(&self, _observations: &[f32], _actions: &[f32]) -> Result<Vec<f32>> {
        let Chunk { history, length, .. } = self.chunk;
        match self.choice() {
            Some(_) => Err(PolicyError::ValuesChunks { history, length }),
            None => Err(PolicyError::NoCritics),
        }
    }
}

#[cfg(test)]
mod tests;
