//! Rows of a dataset in file order, whatever its format.

use crate::same_state::SameState;
use crate::statistics::EpisodeReturn;

/// The attribute of the names of observation columns, and that of action columns.
pub(crate) const OBSERVATION_NAMES: &str = "observation_names";
pub(crate) const ACTION_NAMES: &str = "action_names";

/// Distance at which the locomotion rule's source (IQL, Kostrikov et al. 2021) ends a trajectory.
const SAME_OBSERVATION: f64 = 1e-6;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RowKind {
    Transition,
    /// Step without a transition by the format's rules, counted in its episode's return.
    Dropped,
    /// Final state of an episode, without an action.
    LastState,
}

/// Names of the dimensions of observations and actions; empty if the source has none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Names {
    /// One name per observation dimension.
    pub observations: Vec<String>,
    /// One name per action dimension.
    pub actions: Vec<String>,
}

/// N rows of a dataset. The end of the file truncates the last episode.
#[derive(Default)]
pub(crate) struct Recording {
    pub observation_dim: usize,
    pub action_dim: usize,
    /// N × o.
    pub observations: Vec<f32>,
    /// N × a.
    pub actions: Vec<f32>,
    pub rewards: Vec<f32>,
    /// N × o, if the format stores them; else the following row's observation is used.
    pub next_observations: Option<Vec<f32>>,
    /// N × o, stored in a D4RL file and used only for checks.
    pub unused_next_observations: Option<Vec<f32>>,
    /// True if a row's stored next observation, of either kind, is not the state in which the
    /// following row starts; empty if the format stores none.
    pub jumps: Vec<bool>,
    pub kinds: Vec<RowKind>,
    /// True where the mask is 0, so that the critics do not bootstrap.
    pub terminals: Vec<bool>,
    /// Path of the array of terminals, for messages.
    pub terminal_array: &'static str,
    /// True where the episode was truncated after the row.
    pub timeouts: Vec<bool>,
    pub ends: Vec<bool>,
    /// True if the task is to reach a goal, after which the recording continues.
    pub goal: bool,
    pub names: Names,
    /// First row and group path of each part, if the file has one group per episode.
    pub parts: Vec<(usize, String)>,
    /// Doubts of the reader: what it takes for granted of arrays that the source lacks.
    pub doubts: Vec<String>,
}

impl Recording {
    /// The recording with [`Self::jumps`].
    pub(crate) fn with_jumps(mut self) -> Self {
        let unused = self.unused_next_observations.as_ref();
        let Some(stored) = self.next_observations.as_ref().or(unused) else { return self };
        let same = SameState::between(&self.observations, stored, self.observation_dim);
        let jumps = |row: usize| {
            let (next, start) = (self.state(stored, row), self.observation(row + 1));
            same.differ(next, start)
        };
        self.jumps = (1..=self.rows()).map(|next| next < self.rows() && jumps(next - 1)).collect();
        self
    }

    pub(crate) fn rows(&self) -> usize {
        self.rewards.len()
    }

    pub(crate) fn observation(&self, row: usize) -> &[f32] {
        self.state(&self.observations, row)
    }

    pub(crate) fn action(&self, row: usize) -> &[f32] {
        &self.actions[row * self.action_dim..(row + 1) * self.action_dim]
    }

    /// State after a row's step.
    pub(crate) fn next_observation(&self, row: usize) -> &[f32] {
        match &self.next_observations {
            Some(stored) => self.state(stored, row),
            None => self.observation(row + 1),
        }
    }

    fn state<'a>(&self, observations: &'a [f32], row: usize) -> &'a [f32] {
        &observations[row * self.observation_dim..(row + 1) * self.observation_dim]
    }

    /// True if an action is taken in a row; false in an episode's final state, and after the end.
    pub(crate) fn is_step(&self, row: usize) -> bool {
        row < self.rows() && self.kinds[row] != RowKind::LastState
    }

    /// Rows in which an action is taken.
    pub(crate) fn steps(&self) -> impl Iterator<Item = usize> {
        (0..self.rows()).filter(|&row| self.is_step(row))
    }

    /// Rows that start a transition.
    pub(crate) fn transitions(&self) -> impl Iterator<Item = usize> {
        (0..self.rows()).filter(|&row| self.kinds[row] == RowKind::Transition)
    }

    /// True where the episode has reached its goal in an earlier row.
    pub(crate) fn past_goal(&self) -> Vec<bool> {
        let mut is_past = false;
        let was_past = |row: usize| {
            let was_past = is_past;
            is_past = self.goal && !self.ends[row] && (is_past || self.terminals[row]);
            was_past
        };
        (0..self.rows()).map(was_past).collect()
    }

    /// Length and return of each episode, dropped steps included. Rewards after the first positive
    /// one do not count if there is a goal.
    pub(crate) fn episodes(&self) -> Vec<EpisodeReturn> {
        let (mut episodes, mut open) = (Vec::new(), EpisodeReturn::default());
        let mut is_reached = false;
        for row in self.steps() {
            let reward = f64::from(self.rewards[row]);
            open.length += 1;
            open.sum += if is_reached { 0.0 } else { reward };
            is_reached |= self.goal && reward > 0.0;
            if self.ends[row] {
                is_reached = false;
                episodes.push(std::mem::take(&mut open));
            }
        }
        episodes.extend((open.length > 0).then_some(open));
        episodes
    }

    /// Returns of trajectories as the locomotion rule defines them: runs of transitions up to a
    /// terminal, the end of an episode, or a discontinuity.
    pub(crate) fn trajectory_returns(&self) -> Vec<f64> {
        let mut rows = self.transitions().peekable();
        let (mut returns, mut open) = (Vec::new(), 0.0);
        while let Some(row) = rows.next() {
            open += f64::from(self.rewards[row]);
            let goes_on = rows.peek().is_some_and(|next| self.continues(row, *next));
            if self.terminals[row] || self.ends[row] || !goes_on {
                returns.push(std::mem::take(&mut open));
            }
        }
        returns
    }

    /// Steps with a following step in their episode.
    pub(crate) fn inside(&self) -> impl Iterator<Item = usize> {
        let last = self.rows().saturating_sub(1);
        (0..last).filter(|&row| self.is_step(row) && !self.ends[row])
    }

    /// True if the following row is the next step of the episode and starts in `row`'s next state.
    pub(crate) fn goes_on(&self, row: usize) -> bool {
        !self.terminals[row] && self.recording_goes_on(row)
    }

    /// [`Self::goes_on`], also after a success that does not end the recorded episode.
    pub(crate) fn recording_goes_on(&self, row: usize) -> bool {
        let are_steps = self.is_step(row) && self.is_step(row + 1);
        are_steps && !self.ends[row] && !(self.next_observations.is_some() && self.jumps(row))
    }

    /// True if `following`, the next transition after `row`, starts in its next state.
    fn continues(&self, row: usize, following: usize) -> bool {
        if following == row + 1 {
            return self.next_observations.is_none() || !self.jumps(row);
        }
        let (start, next) = (self.observation(following), self.observation(row + 1));
        let apart = start.iter().zip(next).map(|(a, b)| f64::from(a - b));
        apart.map(|x| x.powi(2)).sum::<f64>().sqrt() <= SAME_OBSERVATION
    }

    /// True if a row's stored next observation is not the state in which the following row starts.
    pub(crate) fn jumps(&self, row: usize) -> bool {
        self.jumps.get(row) == Some(&true)
    }

    /// Appends a final state to all columns but the observations.
    pub(crate) fn push_last_state(&mut self) {
        let numbers = self.actions.len() + self.action_dim;
        self.actions.resize(numbers, 0.0);
        self.rewards.push(0.0);
        self.kinds.push(RowKind::LastState);
        for flags in [&mut self.terminals, &mut self.timeouts, &mut self.ends] {
            flags.push(false);
        }
    }

    /// Path of the array that holds `row` of a column, and the index there.
    pub(crate) fn place(&self, column: &str, row: usize) -> (String, usize) {
        match self.parts.iter().rev().find(|(first, _)| *first <= row) {
            None => (column.to_owned(), row),
            Some((first, group)) => (format!("{group}/{column}"), row - first),
        }
    }
}

/// Columns by number and, if they have one, name.
pub(crate) fn named(columns: &[usize], names: &[String]) -> String {
    let one = |column: &usize| match names.get(*column) {
        Some(name) => format!("{column} ({name})"),
        None => column.to_string(),
    };
    let columns = Vec::from_iter(columns.iter().map(one));
    let ending = if columns.len() == 1 { "" } else { "s" };
    format!("column{ending} {}", columns.join(", "))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::RowKind::{Dropped, Transition};
    use super::*;

    /// Observation, action × 100 and reward of each row are its index.
    pub(crate) fn recording(kinds: &[RowKind]) -> Recording {
        let n = kinds.len();
        Recording {
            observation_dim: 1,
            action_dim: 1,
            observations: (0..n).map(|row| row as f32).collect(),
            actions: (0..n).map(|row| row as f32 / 100.0).collect(),
            rewards: (0..n).map(|row| row as f32).collect(),
            kinds: kinds.to_vec(),
            terminals: vec![false; n],
            timeouts: vec![false; n],
            ends: vec![false; n],
            ..Recording::default()
        }
    }

    impl Recording {
        pub(crate) fn store_next(&mut self, next: Vec<f32>) {
            self.next_observations = Some(next);
            *self = std::mem::take(self).with_jumps();
        }
    }

    #[test]
    fn rows_are_found_again_in_their_part() {
        let mut recording = recording(&[Transition; 6]);
        assert_eq!(recording.place("rewards", 4), ("rewards".into(), 4));
        recording.parts = vec![(0, "episode_0".into()), (3, "episode_1".into())];
        let place = recording.place("rewards", 4);
        assert_eq!(place, ("episode_1/rewards".into(), 1));
    }

    #[test]
    fn a_trajectory_ends_where_a_stored_next_observation_is_not_the_next_row_s() {
        let mut recording = recording(&[Transition; 4]);
        assert_eq!(recording.trajectory_returns(), [6.0]);
        recording.store_next(vec![1.0, 9.0, 3.0, 4.0]);
        assert_eq!(recording.trajectory_returns(), [1.0, 5.0]);
    }

    #[test]
    fn a_trajectory_goes_on_through_a_dropped_row_that_is_the_state_of_the_next() {
        let mut recording = recording(&[Transition, Dropped, Transition, Dropped]);
        for (start, expected) in [(1.0, &[2.0][..]), (1.0001, &[0.0, 2.0])] {
            recording.observations[2] = start;
            assert_eq!(recording.trajectory_returns(), expected, "{start}");
        }
    }
}
