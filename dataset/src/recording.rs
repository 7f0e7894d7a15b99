//! Rows of a dataset of any format, as they were recorded.

use crate::rounding::Rounding;
use crate::statistics::{Episode, returns};

/// Two rows whose observations differ by more than this do not follow one another.
const SAME_OBSERVATION: f64 = 1e-6;

/// Use of a row in training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RowKind {
    /// A step to learn from.
    Transition,
    /// A step that the format's rules drop: it counts toward its episode and nothing else.
    Dropped,
    /// No step, but the last state of an episode, to which the row before leads.
    LastState,
}

/// Names of the numbers of a row; empty lists where a source has none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Names {
    /// Names of the numbers of an observation, o.
    pub observations: Vec<String>,
    /// Names of the numbers of an action, a.
    pub actions: Vec<String>,
}

/// Rows of a dataset, N of them. What follows the last end of an episode is an episode, too, cut
/// off by the file's end.
#[derive(Default)]
pub(crate) struct Recording {
    /// Numbers in an observation, o.
    pub observation_dim: usize,
    /// Numbers in an action, a.
    pub action_dim: usize,
    /// N × o.
    pub observations: Vec<f32>,
    /// N × a.
    pub actions: Vec<f32>,
    /// N.
    pub rewards: Vec<f32>,
    /// N × o, where the format stores them apart. Else the following row's observation is the next
    /// one.
    pub next_observations: Option<Vec<f32>>,
    /// N × o, where a D4RL file stores them although the following row's observation is the next
    /// one.
    pub unused_next_observations: Option<Vec<f32>>,
    /// What was done to observations and not to the next ones that are stored, or the other way
    /// round.
    pub rounding: Rounding,
    /// N.
    pub kinds: Vec<RowKind>,
    /// Whether a row is terminal, so that its mask is 0 and the critics do not bootstrap; N.
    pub terminals: Vec<bool>,
    /// The array, or those of its parts, that says so.
    pub terminal_array: &'static str,
    /// Whether the episode was cut off after a row; N.
    pub timeouts: Vec<bool>,
    /// Whether a row is the last step of its episode; N.
    pub ends: Vec<bool>,
    /// Whether the task is to reach a goal, after which the recording continues.
    pub goal: bool,
    /// What the numbers of its rows are called.
    pub names: Names,
    /// Where the file has several arrays of each kind: the first row of each, and the path of the
    /// group it is in.
    pub parts: Vec<(usize, String)>,
}

impl Recording {
    pub(crate) fn rows(&self) -> usize {
        self.rewards.len()
    }

    pub(crate) fn observation(&self, row: usize) -> &[f32] {
        &self.observations[row * self.observation_dim..(row + 1) * self.observation_dim]
    }

    pub(crate) fn action(&self, row: usize) -> &[f32] {
        &self.actions[row * self.action_dim..(row + 1) * self.action_dim]
    }

    /// Numbers of the rows to learn from, in order.
    pub(crate) fn transitions(&self) -> impl Iterator<Item = u32> {
        let kinds = self.kinds.iter().zip(0..);
        kinds.filter(|(kind, _)| **kind == RowKind::Transition).map(|(_, row)| row)
    }

    /// Whether each row's episode has reached its goal before: a recording of a task with one
    /// continues there.
    pub(crate) fn past_goal(&self) -> Vec<bool> {
        let mut is_past = false;
        let of_row = |row: usize| {
            let was_past = is_past;
            is_past = self.goal && !self.ends[row] && (is_past || self.terminals[row]);
            was_past
        };
        (0..self.rows()).map(of_row).collect()
    }

    /// All episodes, every recorded step included.
    pub(crate) fn episodes(&self) -> Vec<Episode> {
        let mut episodes = Vec::new();
        let mut open = Episode::default();
        for row in (0..self.rows()).filter(|&row| self.kinds[row] != RowKind::LastState) {
            open.push(f64::from(self.rewards[row]), self.goal);
            if self.ends[row] {
                episodes.push(std::mem::take(&mut open));
            }
        }
        episodes.extend((open.length > 0).then_some(open));
        episodes
    }

    /// Returns of the trajectories that the locomotion rule speaks of: runs of rows to learn from,
    /// each up to a terminal, the end of an episode, or a row that does not lead to the next one.
    pub(crate) fn trajectory_returns(&self) -> Vec<f64> {
        let following = self.transitions().skip(1).map(Some).chain([None]);
        let rows = self.transitions().zip(following).map(|(row, following)| {
            let row = row as usize;
            let ends = self.terminals[row]
                || self.ends[row]
                || following.is_none_or(|following| !self.continues(row, following as usize));
            (self.rewards[row], ends)
        });
        returns(rows)
    }

    /// Rows to which the following row is said to belong.
    pub(crate) fn inside(&self) -> impl Iterator<Item = usize> {
        let last = self.rows().saturating_sub(1);
        (0..last).filter(|&row| self.kinds[row] != RowKind::LastState && !self.ends[row])
    }

    /// Whether the row after `row` is the next step of its episode, taken where this one led to.
    pub(crate) fn goes_on(&self, row: usize) -> bool {
        let ends = self.ends[row] || self.terminals[row] || self.kinds[row] == RowKind::LastState;
        let is_step = self.kinds.get(row + 1).is_some_and(|kind| *kind != RowKind::LastState);
        !ends
            && is_step
            && !self.next_observations.as_ref().is_some_and(|next| self.jumps(next, row))
    }

    /// Whether `following`, the next row to learn from after `row`, continues where that one led
    /// to.
    fn continues(&self, row: usize, following: usize) -> bool {
        following == row + 1
            || !differ(self.observation(following), self.observation(row + 1), Rounding::default())
    }

    /// Whether a row's stored next observation is not where the following row starts.
    pub(crate) fn jumps(&self, next_observations: &[f32], row: usize) -> bool {
        let next = &next_observations[row * self.observation_dim..(row + 1) * self.observation_dim];
        row + 1 < self.rows() && differ(next, self.observation(row + 1), self.rounding)
    }

    /// The name of the array that holds row `row` of a column, and the row's number there.
    pub(crate) fn place(&self, column: &str, row: usize) -> (String, usize) {
        match self.parts.iter().rev().find(|(first, _)| *first <= row) {
            None => (column.to_owned(), row),
            Some((first, group)) => (format!("{group}/{column}"), row - first),
        }
    }
}

/// Whether two observations are more than rounding apart.
fn differ(a: &[f32], b: &[f32], rounding: Rounding) -> bool {
    let apart = a.iter().zip(b).filter(|(a, b)| !rounding.explains(**a, **b));
    apart.map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt() > SAME_OBSERVATION
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Rows whose observation, action (in hundredths) and reward are their number.
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

    #[test]
    fn rows_are_found_again_in_their_part() {
        let mut recording = recording(&[RowKind::Transition; 6]);
        assert_eq!(recording.place("rewards", 4), ("rewards".to_owned(), 4));
        recording.parts = vec![(0, "episode_0".to_owned()), (3, "episode_1".to_owned())];
        assert_eq!(recording.place("rewards", 4), ("episode_1/rewards".to_owned(), 1));
    }
}
