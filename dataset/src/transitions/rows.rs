//! Rows in recorded order, and batches of the transitions that start in them.

use std::ops::Range;

use quad_kernels::scaling::Scaling;

use crate::normalize;
use crate::recording::Recording;
use crate::tables::reward::RewardScaling;

/// Bound at which actions are clipped, within the range of tanh policies.
const ACTION_LIMIT: f32 = 1.0 - 1e-5;

/// Mini-batch of B transitions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// s, B × o.
    pub observations: Vec<f32>,
    /// a, B × a.
    pub actions: Vec<f32>,
    /// r, B.
    pub rewards: Vec<f32>,
    /// s', B × o.
    pub next_observations: Vec<f32>,
    /// 0 where the episode terminated, else 1; B.
    pub masks: Vec<f32>,
    /// Number of transitions, B.
    pub size: usize,
}

impl Batch {
    pub(super) fn clear(&mut self) {
        for array in [
            &mut self.observations,
            &mut self.actions,
            &mut self.rewards,
            &mut self.next_observations,
            &mut self.masks,
        ] {
            array.clear();
        }
    }
}

/// N rows, scaled. An index counts transitions only.
#[derive(Default)]
pub(super) struct Rows {
    pub observation_dim: usize,
    pub action_dim: usize,
    /// N × o.
    pub observations: Vec<f32>,
    /// N × a, clipped.
    pub actions: Vec<f32>,
    rewards: Vec<f32>,
    /// N × o, if the source has them; else a transition leads to the following row.
    next_observations: Option<Vec<f32>>,
    terminals: Vec<bool>,
    /// Rows that start a transition.
    pub starts: Vec<u32>,
    goes_on: Vec<bool>,
}

impl Rows {
    pub fn new(mut recording: Recording, reward: RewardScaling, scaling: &Scaling) -> Self {
        let starts = recording.transitions().collect();
        let goes_on = (0..recording.rows()).map(|row| recording.goes_on(row)).collect();
        normalize::apply(scaling, &mut recording);
        let Recording {
            observation_dim, action_dim, observations, mut actions, mut rewards, ..
        } = recording;
        actions.iter_mut().for_each(|action| *action = action.clamp(-ACTION_LIMIT, ACTION_LIMIT));
        let size = scaling.rewards.unwrap_or(1.0);
        rewards.iter_mut().for_each(|it| *it = reward.apply(*it) / size);
        Self {
            observation_dim,
            action_dim,
            observations,
            actions,
            rewards,
            next_observations: recording.next_observations,
            terminals: recording.terminals,
            starts,
            goes_on,
        }
    }

    /// No rows, of the same dimensions.
    pub fn none(&self) -> Self {
        let Self { observation_dim, action_dim, .. } = *self;
        Self { observation_dim, action_dim, ..Self::default() }
    }

    /// Adds rows without next observations of their own.
    pub fn extend(&mut self, rows: Self) {
        let first = self.rewards.len() as u32;
        self.observations.extend(rows.observations);
        self.actions.extend(rows.actions);
        self.rewards.extend(rows.rewards);
        self.terminals.extend(rows.terminals);
        self.starts.extend(rows.starts.iter().map(|row| first + row));
        self.goes_on.extend(rows.goes_on);
    }

    /// Number of transitions.
    pub fn len(&self) -> usize {
        self.starts.len()
    }

    pub fn next(&self, index: u32) -> Option<u32> {
        let row = self.starts[index as usize];
        let is_next = self.starts.get(index as usize + 1) == Some(&(row + 1));
        (is_next && self.goes_on[row as usize]).then_some(index + 1)
    }

    pub fn next_action(&self, index: u32) -> Option<&[f32]> {
        let row = self.starts[index as usize] as usize;
        let next = (row + 1) * self.action_dim..(row + 2) * self.action_dim;
        self.goes_on[row].then(|| &self.actions[next])
    }

    pub fn episodes(&self) -> Vec<Range<u32>> {
        let mut episodes = Vec::new();
        let mut start = 0;
        for index in 0..self.len() as u32 {
            if self.next(index).is_none() {
                episodes.push(start..index + 1);
                start = index + 1;
            }
        }
        episodes
    }

    pub fn copy_to(&self, batch: &mut Batch, index: u32) {
        let (o, a) = (self.observation_dim, self.action_dim);
        let row = self.starts[index as usize] as usize;
        batch.observations.extend_from_slice(&self.observations[row * o..(row + 1) * o]);
        batch.actions.extend_from_slice(&self.actions[row * a..(row + 1) * a]);
        batch.rewards.push(self.rewards[row]);
        let next = match &self.next_observations {
            Some(next_observations) => &next_observations[row * o..(row + 1) * o],
            None => &self.observations[(row + 1) * o..(row + 2) * o],
        };
        batch.next_observations.extend_from_slice(next);
        batch.masks.push(if self.terminals[row] { 0.0 } else { 1.0 });
    }
}
