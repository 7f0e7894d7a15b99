//! Rows in recorded order, and batches of the transitions or windows that start in them.

use std::ops::Range;

use quad_kernels::scaling::Scaling;

use crate::normalize;
use crate::recording::Recording;
use crate::tables::reward::RewardScaling;

/// Bound at which actions are clipped, within the range of tanh policies.
const ACTION_LIMIT: f32 = 1.0 - 1e-5;

/// The steps that an example covers: h in a row, fewer where the recorded episode ends before. A
/// success that does not end it, as in OGBench's data, is passed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Number k ≥ 1 of observations that are seen at a time. An episode's first observation stands
    /// for those before it.
    pub history: usize,
    /// Number h ≥ 1 of steps.
    pub length: usize,
    /// Discount γ of a step.
    pub gamma: f32,
}

impl Window {
    /// A single transition.
    pub const ONE: Self = Self { history: 1, length: 1, gamma: 1.0 };
}

/// Mini-batch of B transitions, or of B windows of n ≤ h transitions.
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    /// s_{t−k+1} … s_t, B × k·o.
    pub observations: Vec<f32>,
    /// a_t … a_{t+h−1}, B × h·a. After the n-th, where the episode ends, that is repeated.
    pub actions: Vec<f32>,
    /// Σ γ^i·r_{t+i} over the n steps, B.
    pub rewards: Vec<f32>,
    /// s_{t+n−k+1} … s_{t+n}, B × k·o.
    pub next_observations: Vec<f32>,
    /// 0 where one of the n steps is terminal, else γ^(n−1), which is 1 for a transition; B.
    pub masks: Vec<f32>,
    /// n, B.
    pub steps: Vec<usize>,
}

/// Rows of a dataset or of experience. An index counts transitions only.
pub(super) struct Rows {
    /// Scaled; actions are also clipped.
    pub recording: Recording,
    /// Rows that start a transition.
    pub starts: Vec<u32>,
    /// [`Recording::recording_goes_on`] of each row.
    goes_on: Vec<bool>,
}

impl Rows {
    pub fn new(mut recording: Recording, reward_rule: RewardScaling, scaling: &Scaling) -> Self {
        let starts = Vec::from_iter(recording.transitions().map(|row| row as u32));
        let goes_on =
            Vec::from_iter((0..recording.rows()).map(|row| recording.recording_goes_on(row)));
        normalize::apply(scaling, &mut recording);
        for action in &mut recording.actions {
            *action = action.clamp(-ACTION_LIMIT, ACTION_LIMIT);
        }
        for reward in &mut recording.rewards {
            *reward = reward_rule.apply(*reward) / scaling.rewards.unwrap_or(1.0);
        }
        Self { recording, starts, goes_on }
    }

    /// No rows, of the same dimensions.
    pub fn none(&self) -> Self {
        let Recording { observation_dim, action_dim, .. } = self.recording;
        let recording = Recording { observation_dim, action_dim, ..Recording::default() };
        Self { recording, starts: Vec::new(), goes_on: Vec::new() }
    }

    /// Adds rows without next observations of their own.
    pub fn extend(&mut self, rows: &Self) {
        let first = self.recording.rows() as u32;
        self.recording.extend(&rows.recording, 0..rows.recording.rows());
        self.starts.extend(rows.starts.iter().map(|row| first + row));
        self.goes_on.extend(&rows.goes_on);
    }

    /// Number of transitions.
    pub fn len(&self) -> usize {
        self.starts.len()
    }

    pub fn next(&self, index: u32) -> Option<u32> {
        self.following(index).filter(|_| !self.terminates(index))
    }

    /// The next transition of the recorded episode, also after a success.
    fn following(&self, index: u32) -> Option<u32> {
        let row = self.starts[index as usize];
        let is_next = self.starts.get(index as usize + 1) == Some(&(row + 1));
        (is_next && self.goes_on[row as usize]).then_some(index + 1)
    }

    pub fn terminates(&self, index: u32) -> bool {
        self.recording.terminals[self.starts[index as usize] as usize]
    }

    pub fn next_action(&self, index: u32) -> Option<&[f32]> {
        let row = self.starts[index as usize] as usize;
        (self.goes_on[row] && !self.terminates(index)).then(|| self.recording.action(row + 1))
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

    /// The transition at `index` after the `length` − 1 that come before it, the first of an episode
    /// as often as it takes.
    fn history(&self, index: u32, length: usize) -> impl Iterator<Item = u32> {
        let leads_on = |back: &u32| *back <= index && self.following(index - back).is_some();
        let before = (1..length as u32).take_while(leads_on).count() as u32;
        (0..length as u32).rev().map(move |back| index - back.min(before))
    }

    /// Adds the window that begins with the transition at `index`.
    pub fn copy_to(&self, batch: &mut Batch, index: u32, window: Window) {
        let (rows, row) = (&self.recording, |index: u32| self.starts[index as usize] as usize);
        for seen in self.history(index, window.history) {
            batch.observations.extend_from_slice(rows.observation(row(seen)));
        }
        batch.actions.extend_from_slice(rows.action(row(index)));
        let (mut last, mut reward, mut discount, mut steps) =
            (index, rows.rewards[row(index)], 1.0, 1);
        let mut terminated = self.terminates(index);
        for _ in 1..window.length {
            if let Some(next) = self.following(last) {
                discount *= window.gamma;
                reward += discount * rows.rewards[row(next)];
                terminated |= self.terminates(next);
                (last, steps) = (next, steps + 1);
            }
            batch.actions.extend_from_slice(rows.action(row(last)));
        }
        batch.rewards.push(reward);
        for seen in self.history(last, window.history - 1) {
            batch.next_observations.extend_from_slice(rows.observation(row(seen)));
        }
        batch.next_observations.extend_from_slice(rows.next_observation(row(last)));
        batch.masks.push(if terminated { 0.0 } else { discount });
        batch.steps.push(steps);
    }
}
