//! From a file's rows to transitions (s, a, r, s', mask), by the rules of D4RL's `qlearning_dataset`, IQL and DAC.

use std::path::Path;

use crate::file::DatasetFile;
use crate::statistics::{Statistics, returns};
use crate::{Batch, DatasetError, EnvironmentSpec, RewardRule};

/// Actions are kept this far within ±1, where policies that squash can still reach them.
const ACTION_LIMIT: f32 = 1.0 - 1e-5;

/// Two rows whose observations differ by more than this do not follow one another.
const SAME_OBSERVATION: f64 = 1e-6;

/// How a file is to be read.
#[derive(Clone, Copy, Debug)]
pub struct ReadOptions {
    /// The environment it was recorded in, if it is known: sizes, time limit and reference returns come from there. Else
    /// the file's own sizes count, and without timeouts nothing is cut off.
    pub environment: Option<&'static EnvironmentSpec>,
    /// What happens to its rewards.
    pub reward: RewardRule,
}

/// Transitions to learn from.
///
/// The file's rows stay as they are; a transition is the number i of a kept row, and its next observation is row i + 1's.
/// Kept are all rows but the last and the timeouts. A terminal row's next observation belongs to another episode,
/// but its mask is 0.
pub struct Transitions {
    observation_dim: usize,
    action_dim: usize,
    /// N × o.
    observations: Vec<f32>,
    /// N × a, clipped.
    actions: Vec<f32>,
    /// N, scaled.
    rewards: Vec<f32>,
    /// N.
    terminals: Vec<bool>,
    /// Kept rows, in order.
    rows: Vec<u32>,
    statistics: Statistics,
}

impl Transitions {
    /// Reads D4RL's flat layout: `observations`, `actions`, `rewards`, `terminals` and, if there, `timeouts`. Without
    /// timeouts, a row at which an episode reaches the environment's time limit counts as one.
    pub fn read(path: impl AsRef<Path>, options: &ReadOptions) -> Result<Self, DatasetError> {
        let ReadOptions { environment, reward } = *options;
        let file = DatasetFile::open(path.as_ref())?;
        let (observation_dim, action_dim) = match environment {
            Some(environment) => (environment.observation_dim, environment.action_dim),
            None => (file.width("observations")?, file.width("actions")?),
        };
        let observations = file.numbers::<f32>("observations", observation_dim)?;
        let mut actions = file.numbers::<f32>("actions", action_dim)?;
        let mut rewards = file.numbers::<f32>("rewards", 1)?;
        let terminals = file.flags("terminals")?;
        let timeouts = match file.has("timeouts") {
            true => file.flags("timeouts")?,
            false => {
                derive_timeouts(&terminals, environment.map_or(usize::MAX, |environment| environment.max_episode_steps))
            }
        };

        let transitions = file.rows().saturating_sub(1);
        let rows: Vec<u32> = (0..transitions as u32).filter(|&row| !timeouts[row as usize]).collect();
        if rows.is_empty() {
            return Err(DatasetError::NoTransitions { path: file.path().into(), rows: file.rows() });
        }
        let ends = trajectory_ends(&rows, &terminals, &observations, observation_dim);
        let trajectory_returns = returns(rows.iter().map(|&row| rewards[row as usize]).zip(ends));
        let scaling = reward
            .scaling(&trajectory_returns)
            .ok_or_else(|| DatasetError::SameReturns { path: file.path().into() })?;
        let episode_ends = terminals.iter().zip(&timeouts).map(|(&terminal, &timeout)| terminal || timeout);
        let episode_returns = returns(rewards.iter().copied().zip(episode_ends));
        let statistics = Statistics::new(environment, rows.len(), &episode_returns);

        actions.iter_mut().for_each(|action| *action = action.clamp(-ACTION_LIMIT, ACTION_LIMIT));
        rewards.iter_mut().for_each(|reward| *reward = scaling.apply(*reward));
        Ok(Self { observation_dim, action_dim, observations, actions, rewards, terminals, rows, statistics })
    }

    /// Number of transitions, at least 1.
    #[allow(clippy::len_without_is_empty)] // Never empty.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Numbers in an observation.
    pub fn observation_dim(&self) -> usize {
        self.observation_dim
    }

    /// Numbers in an action.
    pub fn action_dim(&self) -> usize {
        self.action_dim
    }

    /// What the file holds, from the rewards as they were recorded.
    pub fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// Copies the transitions of these numbers (each below [`len`](Self::len)), in this order, over what `batch` holds.
    pub fn gather(&self, indices: &[u32], batch: &mut Batch) {
        let (o, a) = (self.observation_dim, self.action_dim);
        batch.clear();
        batch.size = indices.len();
        for &index in indices {
            let row = self.rows[index as usize] as usize;
            batch.observations.extend_from_slice(&self.observations[row * o..(row + 1) * o]);
            batch.actions.extend_from_slice(&self.actions[row * a..(row + 1) * a]);
            batch.rewards.push(self.rewards[row]);
            batch.next_observations.extend_from_slice(&self.observations[(row + 1) * o..(row + 2) * o]);
            batch.masks.push(if self.terminals[row] { 0.0 } else { 1.0 });
        }
    }
}

/// The rows at which an episode reaches `limit` steps.
fn derive_timeouts(terminals: &[bool], limit: usize) -> Vec<bool> {
    let mut steps = 0;
    let timeout = |&terminal: &bool| {
        steps += 1;
        let timeout = steps == limit;
        if terminal || timeout {
            steps = 0;
        }
        timeout
    };
    terminals.iter().map(timeout).collect()
}

/// Whether a trajectory ends at each kept row: at a terminal, or where the next kept row does not continue it.
fn trajectory_ends<'a>(
    rows: &'a [u32],
    terminals: &'a [bool],
    observations: &'a [f32],
    observation_dim: usize,
) -> impl Iterator<Item = bool> + 'a {
    let observation = move |row: usize| &observations[row * observation_dim..(row + 1) * observation_dim];
    let following = rows.iter().skip(1).map(|&row| Some(row as usize)).chain([None]);
    rows.iter().zip(following).map(move |(&row, following)| {
        let next = row as usize + 1;
        terminals[row as usize]
            || following.is_none_or(|following| {
                following != next && distance(observation(following), observation(next)) > SAME_OBSERVATION
            })
    })
}

fn distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_limit_makes_timeouts_and_restarts_with_each_episode() {
        let (f, t) = (false, true);
        // Episodes of 3 (limit), 1 (terminal), 3 (limit and terminal), 2 (open) steps.
        let terminals = [f, f, f, t, f, f, t, f, f];
        assert_eq!(derive_timeouts(&terminals, 3), [f, f, t, f, f, f, t, f, f]);
    }

    #[test]
    fn a_trajectory_ends_at_terminals_at_jumps_and_at_the_last_row() {
        let observations = [0.0, 1.0, 2.0, 3.0, 9.0, 5.0, 5.0, 6.0];
        let terminals = [false, true, false, false, false, false, false, false];
        // Rows 3 and 5 are dropped. After 2 comes 4, which is not row 3; after 4 comes 6, which equals row 5.
        let rows = [0, 1, 2, 4, 6];
        let ends: Vec<bool> = trajectory_ends(&rows, &terminals, &observations, 1).collect();
        assert_eq!(ends, [false, true, true, false, true]);
    }
}
