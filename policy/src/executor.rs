//! Executes a policy in the environment's units and steps: it scales observations and actions,
//! remembers the last observations, and executes chunks of actions one by one.

use crate::error::{PolicyError, Result, check_range};
use crate::policy::{Policy, Samples};
use crate::sampling::choice::Choice;
use crate::sampling::episode::EpisodeState;
use quad_kernels::scaling::{Affine, Scaling};
use quad_nn::{Precision, f32_bytes};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::mem;
use std::sync::Arc;

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
        Self::open_loop(1)
    }
}

impl Chunk {
    /// A chunk of one observation, of which all steps are executed.
    pub(crate) fn open_loop(length: usize) -> Self {
        let (history, replan) = (1, length);
        Self { history, length, replan }
    }

    pub(crate) fn is_single(&self) -> bool {
        self.length == 1 && self.history == 1
    }
}

struct Executor {
    /// Acts in the networks' units, h actions at a time.
    policy: Box<dyn Policy>,
    chunk: Chunk,
    scaling: Arc<Scaling>,
}

/// A policy in the environment's units and steps. `scaling` is of one observation and one action.
///
/// # Errors
/// Chunk or scaling does not fit the policy's dimensions.
pub(crate) fn executor(
    policy: Box<dyn Policy>,
    chunk: Chunk,
    scaling: Scaling,
) -> Result<Box<dyn Policy>> {
    if chunk.is_single() && scaling == Scaling::default() {
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
    let o = policy.observation_dim() / chunk.history;
    let a = policy.action_dim() / chunk.length;
    let Scaling { observations, actions, .. } = &scaling;
    for (what, affine, columns) in [("observations", observations, o), ("actions", actions, a)] {
        match affine {
            Some(affine) if !affine.is_usable(columns) => {
                return Err(PolicyError::Scaling { what, columns });
            }
            _ => {}
        }
    }
    let scaling = scaling.into();
    Ok(Box::new(Executor { policy, chunk, scaling }))
}

fn to_network<'a>(affine: Option<&Affine>, numbers: &'a [f32]) -> Cow<'a, [f32]> {
    let mut numbers = Cow::from(numbers);
    if let Some(affine) = affine {
        affine.to_network(numbers.to_mut());
    }
    numbers
}

impl Executor {
    fn scaled<'a>(&self, observations: &'a [f32]) -> Cow<'a, [f32]> {
        to_network(self.scaling.observations.as_ref(), observations)
    }

    fn to_user(&self, actions: &mut [f32]) {
        if let Some(affine) = &self.scaling.actions {
            affine.to_user(actions);
        }
    }

    /// Takes the next action of each state's chunk; `draw` acts in the states that have none left.
    fn execute(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
        draw: impl FnOnce(&[f32], &mut [EpisodeState], &mut [f32]) -> Result<()>,
    ) -> Result<()> {
        if self.chunk.is_single() {
            draw(&self.scaled(observations), states, actions)?;
        } else {
            self.observe(observations, states);
            self.refill(states, draw)?;
            for (action, state) in actions.chunks_exact_mut(self.action_dim()).zip(states) {
                let taken = state.chunk.drain(..action.len());
                action.iter_mut().zip(taken).for_each(|(x, next)| *x = next);
            }
        }
        self.to_user(actions);
        Ok(())
    }

    /// Draws chunks in the states that have executed theirs.
    fn refill(
        &self,
        states: &mut [EpisodeState],
        draw: impl FnOnce(&[f32], &mut [EpisodeState], &mut [f32]) -> Result<()>,
    ) -> Result<()> {
        let mut places = Vec::from_iter(0..states.len());
        places.retain(|place| states[*place].chunk.is_empty());
        if places.is_empty() {
            return Ok(());
        }
        let width = self.policy.action_dim();
        let seen = places.iter().flat_map(|place| &states[*place].seen);
        let observations = Vec::from_iter(seen.copied());
        let take = |place: &usize| mem::replace(&mut states[*place], EpisodeState::new(0));
        let mut drawing = Vec::from_iter(places.iter().map(take));
        let mut chunks = vec![0.0; places.len() * width];
        let drawn = draw(&observations, &mut drawing, &mut chunks);
        let executed = self.chunk.replan * self.action_dim();
        let chunks = chunks.chunks_exact(width);
        for ((place, mut state), chunk) in places.into_iter().zip(drawing).zip(chunks) {
            if drawn.is_ok() {
                state.chunk.extend(&chunk[..executed]);
            }
            states[place] = state;
        }
        drawn
    }
}

impl Policy for Executor {
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
        let (chunk, scaling) = (self.chunk, self.scaling.clone());
        let policy = self.policy.with_choice(choice)?;
        Ok(Box::new(Self { policy, chunk, scaling }))
    }

    fn memory(&self, states: usize) -> u64 {
        let mut own = f32_bytes(states as u128 * self.observation_dim() as u128);
        if !self.chunk.is_single() {
            let numbers = 2 * (self.policy.observation_dim() + self.policy.action_dim());
            let moved = states * (size_of::<EpisodeState>() + size_of::<usize>());
            own += f32_bytes(states as u128 * numbers as u128) + moved as u64;
        }
        self.policy.memory(states).saturating_add(own)
    }

    fn observe(&self, observations: &[f32], states: &mut [EpisodeState]) {
        if self.chunk.is_single() {
            return;
        }
        let observations = self.scaled(observations);
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

    fn change_actions(&self, actions: &mut [f32], change: &mut dyn FnMut(&mut [f32])) {
        if let Some(affine) = &self.scaling.actions {
            affine.to_network(actions);
        }
        self.policy.change_actions(actions, change);
        self.to_user(actions);
    }

    /// The first action and the value of each chunk that is drawn, in states without one.
    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Samples> {
        let mut seen = self.scaled(observations);
        if !self.chunk.is_single() {
            self.observe(observations, states);
            seen = Vec::from_iter(states.iter().flat_map(|state| &state.seen).copied()).into();
        }
        let Samples { actions, values } = self.policy.sample(&seen, states)?;
        let first = |chunk: &[f32]| chunk[..self.action_dim()].to_vec();
        let chunks = actions.chunks_exact(self.policy.action_dim());
        let mut actions = Vec::from_iter(chunks.flat_map(first));
        self.to_user(&mut actions);
        Ok(Samples { actions, values })
    }

    fn value(&self, observations: &[f32], actions: &[f32]) -> Result<Vec<f32>> {
        if self.chunk.is_single() {
            let actions = to_network(self.scaling.actions.as_ref(), actions);
            return self.policy.value(&self.scaled(observations), &actions);
        }
        let Chunk { history, length, .. } = self.chunk;
        match self.choice() {
            Some(_) => Err(PolicyError::ValuesChunks { history, length }),
            None => Err(PolicyError::NoCritics),
        }
    }
}

#[cfg(test)]
mod tests;
