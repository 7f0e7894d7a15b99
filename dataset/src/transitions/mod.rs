//! From a source's rows to transitions (s, a, r, s', mask).

pub mod hold_out;
pub mod sampler;
pub mod statistics;

use std::ops::Range;
use std::path::Path;

use quad_kernels::scaling::Scaling;

use crate::error::{DatasetError, Problem};
use crate::formats::Source;
use crate::formats::arrays::Arrays;
use crate::normalize::{self, Normalize};
use crate::recording::{Names, Recording};
use crate::tables::environment::EnvironmentSpec;
use crate::tables::maze::MazeTask;
use crate::tables::reward::{RewardRule, RewardScaling};
use crate::{checks, warnings};
use hold_out::HoldOut;
use statistics::Statistics;

/// Actions are kept this far within ±1, where policies that squash can still reach them.
const ACTION_LIMIT: f32 = 1.0 - 1e-5;

/// A mini-batch of B transitions, each array row by row.
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
    fn clear(&mut self) {
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

/// Options of reading a source.
#[derive(Clone, Copy, Debug, Default)]
pub struct ReadOptions {
    /// The environment it was recorded in, if it is known: sizes, time limit and reference returns
    /// come from there. Else the source's own sizes count, and without timeouts nothing is cut off.
    pub environment: Option<&'static EnvironmentSpec>,
    /// Task in a maze from which rewards and masks follow; else they are the source's.
    pub task: Option<MazeTask>,
    /// Rule for its rewards.
    pub reward: RewardRule,
    /// Columns to normalize; actions that are not normalized must lie within [-1, 1].
    pub normalize: Normalize,
}

/// Transitions to learn from, in the order of the recording. They do not change, so threads can
/// share them.
///
/// The source's rows stay as they are; a transition is the number i of a row, and its next
/// observation is row i + 1's, unless the format stores next observations of their own.
///
/// A transition is followed by the next one if its episode continues there. An episode ends at a
/// terminal, also at a goal after which the recording continues; at a timeout; and where the next
/// row does not start where the transition led to. A row that makes no transition (D4RL's timeouts)
/// is no part of an episode, but its action serves as the previous row's next action.
pub struct Transitions {
    observation_dim: usize,
    action_dim: usize,
    /// N × o, scaled.
    observations: Vec<f32>,
    /// N × a, scaled and clipped.
    actions: Vec<f32>,
    /// N, scaled.
    rewards: Vec<f32>,
    /// N × o, scaled, if there are any.
    next_observations: Option<Vec<f32>>,
    /// N.
    terminals: Vec<bool>,
    /// Rows to learn from, in order.
    rows: Vec<u32>,
    /// Whether the next row is the next step of the episode; N.
    goes_on: Vec<bool>,
    /// Whether the goal was reached earlier in the recorded episode; N.
    past_goal: Vec<bool>,
    statistics: Statistics,
    warnings: Vec<String>,
    scaling: Scaling,
    names: Names,
}

/// Transitions to learn from, and episodes that are kept out of training.
pub struct Split {
    /// To learn from: statistics, scaling and warnings are of these alone.
    pub training: Transitions,
    /// Episodes that are kept out, in the same units; none if the share is 0 or there is but one
    /// episode.
    pub held_out: Option<Transitions>,
    /// Their numbers, from 0 in the order of the file.
    pub episodes: Vec<usize>,
}

impl Transitions {
    /// Reads a D4RL file, a Minari dataset, an OGBench file or one of the custom layout;
    /// docs/data.md has the rules of each. Data that would spoil training is refused: numbers that
    /// are not finite, actions outside [-1, 1] that are not to be scaled, other sizes than the
    /// environment's or another environment, a file that is one endless episode or makes no
    /// transition.
    pub fn read(path: impl AsRef<Path>, options: &ReadOptions) -> Result<Self, DatasetError> {
        Ok(Self::read_split(path, options, HoldOut::NONE)?.training)
    }

    /// As [`Self::read`], but keeps some episodes out.
    pub fn read_split(
        path: impl AsRef<Path>,
        options: &ReadOptions,
        hold_out: HoldOut<'_>,
    ) -> Result<Split, DatasetError> {
        let (path, ReadOptions { environment, task, .. }) = (path.as_ref(), *options);
        let error = |problem| DatasetError::new(path, problem);
        let mut source = Source::open(path)?;
        if let Some(environment) = environment {
            source.check_environment(environment).map_err(error)?;
        }
        let recording = source.read(environment, task)?;
        Self::split(recording, options, hold_out).map_err(error)
    }

    /// Transitions of arrays in memory, with their rewards as they are.
    ///
    /// # Errors
    /// What would spoil training, as in a file.
    pub fn of(arrays: Arrays) -> Result<Self, DatasetError> {
        let error = |problem| DatasetError::new("arrays in memory", problem);
        let recording = arrays.into_recording().map_err(error)?;
        let options = ReadOptions::default();
        Ok(Self::split(recording, &options, HoldOut::NONE).map_err(error)?.training)
    }

    fn split(
        recording: Recording,
        options: &ReadOptions,
        hold_out: HoldOut<'_>,
    ) -> Result<Split, Problem> {
        let ReadOptions { environment, reward, normalize, .. } = *options;
        let problems = checks::problems(&recording, environment);
        let outside = if normalize.actions { None } else { checks::actions_outside(&recording) };
        if let Some(problem) = problems.into_iter().chain(outside).next() {
            return Err(problem);
        }
        let (recording, held_out, episodes) = match hold_out.is_none() {
            true => (recording, None, Vec::new()),
            false => {
                let (training, held_out, episodes) = recording.hold_out(hold_out);
                (training, (!episodes.is_empty()).then_some(held_out), episodes)
            }
        };
        let rewards =
            reward.scaling(&recording.trajectory_returns()).ok_or(Problem::SameReturns)?;
        let scaling = normalize.scaling(&recording, rewards);
        let held_out =
            held_out.map(|held_out| Self::new(held_out, environment, rewards, scaling.clone()));
        let warnings = warnings::warnings(&recording, normalize, reward);
        let training = Self { warnings, ..Self::new(recording, environment, rewards, scaling) };
        Ok(Split {
            training,
            held_out: held_out.filter(|held_out| !held_out.rows.is_empty()),
            episodes,
        })
    }

    fn new(
        mut recording: Recording,
        environment: Option<&EnvironmentSpec>,
        of_rewards: RewardScaling,
        scaling: Scaling,
    ) -> Self {
        let rows: Vec<u32> = recording.transitions().collect();
        let statistics = Statistics::new(environment, rows.len(), &recording.episodes());
        let goes_on = (0..recording.rows()).map(|row| recording.goes_on(row)).collect();
        let past_goal = recording.past_goal();
        normalize::apply(&scaling, &mut recording);
        let Recording {
            observation_dim, action_dim, observations, mut actions, mut rewards, ..
        } = recording;
        actions.iter_mut().for_each(|action| *action = action.clamp(-ACTION_LIMIT, ACTION_LIMIT));
        rewards.iter_mut().for_each(|reward| {
            *reward = of_rewards.apply(*reward) / scaling.rewards.unwrap_or(1.0)
        });
        Self {
            observation_dim,
            action_dim,
            observations,
            actions,
            rewards,
            next_observations: recording.next_observations,
            terminals: recording.terminals,
            rows,
            goes_on,
            past_goal,
            statistics,
            warnings: Vec::new(),
            scaling,
            names: recording.names,
        }
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

    /// Offsets and scales between the recording's numbers and those here; rewards are scaled after
    /// the reward rule.
    pub fn scaling(&self) -> &Scaling {
        &self.scaling
    }

    /// Names of the numbers of observations and actions.
    pub fn names(&self) -> &Names {
        &self.names
    }

    /// Units in which the observations and actions that are learned from have mean 0 and standard
    /// deviation 1, number by number; one that never changes has scale 0.
    pub fn standard_units(&self) -> Scaling {
        let counts = |row: usize| self.rows.binary_search(&(row as u32)).is_ok();
        Scaling {
            observations: Some(normalize::standard_units(
                &self.observations,
                self.observation_dim,
                counts,
            )),
            actions: Some(normalize::standard_units(&self.actions, self.action_dim, counts)),
            rewards: None,
        }
    }

    /// What the file holds, from the rewards as they were recorded.
    pub fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// Signs that little can be learned from them, one sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The number of the transition that follows this one (below [`len`](Self::len)) in its
    /// episode.
    pub fn next(&self, index: u32) -> Option<u32> {
        let row = self.rows[index as usize];
        let is_next = self.rows.get(index as usize + 1) == Some(&(row + 1));
        (is_next && self.goes_on[row as usize]).then_some(index + 1)
    }

    /// The action a' that was taken at s', of length a. Unlike [`next`](Self::next) it is also
    /// there where the next row is a step that makes no transition, so among transitions with mask
    /// 1 it is missing only where it was not recorded.
    pub fn next_action(&self, index: u32) -> Option<&[f32]> {
        let row = self.rows[index as usize] as usize;
        let next = (row + 1) * self.action_dim..(row + 2) * self.action_dim;
        self.goes_on[row].then(|| &self.actions[next])
    }

    /// The numbers of the transitions of each episode, in order; each transition is in one of them.
    pub fn episodes(&self) -> Vec<Range<u32>> {
        let mut episodes = Vec::new();
        let mut start = 0;
        for index in 0..self.rows.len() as u32 {
            if self.next(index).is_none() {
                episodes.push(start..index + 1);
                start = index + 1;
            }
        }
        episodes
    }

    /// Those of [`Self::episodes`] that begin with an episode of the recording: after a goal, where
    /// that continues, each step is an episode of its own.
    pub fn recorded_episodes(&self) -> Vec<Range<u32>> {
        let is_past =
            |episode: &Range<u32>| self.past_goal[self.rows[episode.start as usize] as usize];
        self.episodes().into_iter().filter(|episode| !is_past(episode)).collect()
    }

    /// The first transition of each window of `length` transitions that follow one another: the
    /// window of i is i, i + 1, …, which [`gather`](Self::gather) copies like any others. Episodes
    /// that are shorter have none. `length` is at least 1.
    pub fn window_starts(&self, length: u32) -> Vec<u32> {
        let starts = |episode: Range<u32>| {
            episode.start..(episode.end + 1).saturating_sub(length).max(episode.start)
        };
        self.episodes().into_iter().flat_map(starts).collect()
    }

    /// Copies the transitions of these numbers (each below [`len`](Self::len)), in this order, over
    /// what `batch` holds.
    pub fn gather(&self, indices: &[u32], batch: &mut Batch) {
        let (o, a) = (self.observation_dim, self.action_dim);
        batch.clear();
        batch.size = indices.len();
        batch.observations.reserve(batch.size * o);
        batch.next_observations.reserve(batch.size * o);
        for &index in indices {
            let row = self.rows[index as usize] as usize;
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
}

#[cfg(test)]
mod tests;
