//! Transitions (s, a, r, s', mask) of a dataset.

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
use crate::recording::{Names, Recording, RowKind};
use crate::tables::environment::EnvironmentSpec;
use crate::tables::maze::MazeTask;
use crate::tables::reward::{RewardRule, RewardScaling};
use crate::{checks, warnings};
use hold_out::HoldOut;
use statistics::Statistics;

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

/// Options of [`Transitions::read`].
#[derive(Clone, Copy, Debug, Default)]
pub struct ReadOptions {
    /// Environment that provides dimensions, time limit and reference returns. Without it the
    /// dimensions are the source's, and a file without timeouts has none.
    pub environment: Option<&'static EnvironmentSpec>,
    /// Maze task that replaces the source's rewards and masks.
    pub task: Option<MazeTask>,
    /// Reward rule.
    pub reward: RewardRule,
    /// Columns to normalize. Actions that are not normalized must be within [-1, 1].
    pub normalize: Normalize,
}

/// Immutable transitions for training, in recorded order.
///
/// The source's rows stay in place: transition i starts in row i and leads to row i + 1, unless the
/// format stores next observations.
///
/// An episode ends at a terminal, including a goal after which the recording continues, at a
/// timeout, and at a discontinuity. Rows without a transition (D4RL's timeouts) belong to no
/// episode, but provide the previous row's next action.
pub struct Transitions {
    /// Scaled; actions are also clipped.
    recording: Recording,
    /// Rows that start a transition.
    rows: Vec<u32>,
    goes_on: Vec<bool>,
    /// True after the goal was reached in the recorded episode.
    past_goal: Vec<bool>,
    statistics: Statistics,
    warnings: Vec<String>,
    scaling: Scaling,
}

/// Training and validation transitions.
pub struct Split {
    /// Training transitions; statistics, scaling and warnings are of these alone.
    pub training: Transitions,
    /// Validation transitions, scaled like the training ones; `None` if no episode is held out.
    pub held_out: Option<Transitions>,
    /// Indices of the held-out episodes, from 0 in file order.
    pub episodes: Vec<usize>,
}

impl Transitions {
    /// Reads a dataset of any format by the rules in docs/data.md. Refuses numbers that are not
    /// finite, unnormalized actions outside [-1, 1], other dimensions or another environment than
    /// expected, and files with no transition or no end of an episode.
    pub fn read(path: impl AsRef<Path>, options: &ReadOptions) -> Result<Self, DatasetError> {
        Ok(Self::read_split(path, options, HoldOut::NONE)?.training)
    }

    /// Reads a dataset and splits off validation episodes.
    pub fn read_split(
        path: impl AsRef<Path>,
        options: &ReadOptions,
        hold_out: HoldOut<'_>,
    ) -> Result<Split, DatasetError> {
        let path = path.as_ref();
        let error = |problem| DatasetError::new(path, problem);
        let mut source = Source::open(path)?;
        if let Some(environment) = options.environment {
            source.check_environment(environment).map_err(error)?;
        }
        let recording = source.read(options.environment, options.task)?;
        Self::split(recording, options, hold_out).map_err(error)
    }

    /// Checks and wraps arrays in memory, with unchanged rewards.
    pub fn of(arrays: Arrays) -> Result<Self, DatasetError> {
        let error = |problem| DatasetError::new("arrays in memory", problem);
        let recording = arrays.into_recording().map_err(error)?;
        let split = Self::split(recording, &ReadOptions::default(), HoldOut::NONE);
        Ok(split.map_err(error)?.training)
    }

    fn split(
        recording: Recording,
        options: &ReadOptions,
        hold_out: HoldOut<'_>,
    ) -> Result<Split, Problem> {
        let environment = options.environment;
        let outside = checks::actions_outside(&recording).filter(|_| !options.normalize.actions);
        let problems = checks::problems(&recording, environment).into_iter().chain(outside);
        if let Some(problem) = problems.into_iter().next() {
            return Err(problem);
        }
        let (recording, held_out, episodes) = recording.hold_out(hold_out);
        if recording.transitions().next().is_none() {
            return Err(Problem::NoTransitions(recording.rows()));
        }
        let returns = recording.trajectory_returns();
        let rewards = options.reward.scaling(&returns).ok_or(Problem::SameReturns)?;
        let scaling = options.normalize.scaling(&recording, rewards);
        let new = |recording| Self::new(recording, environment, rewards, scaling.clone());
        let held_out = held_out.map(new).filter(|held_out| !held_out.rows.is_empty());
        let warnings = warnings::warnings(&recording, options.normalize, options.reward);
        let mut training = new(recording);
        training.warnings = warnings;
        Ok(Split { training, held_out, episodes })
    }

    fn new(
        mut recording: Recording,
        environment: Option<&EnvironmentSpec>,
        of_rewards: RewardScaling,
        scaling: Scaling,
    ) -> Self {
        let rows = Vec::from_iter(recording.transitions().map(|row| row as u32));
        let statistics = Statistics::new(environment, rows.len(), &recording.episodes());
        let goes_on = Vec::from_iter((0..recording.rows()).map(|row| recording.goes_on(row)));
        let past_goal = recording.past_goal();
        normalize::apply(&scaling, &mut recording);
        recording.unused_next_observations = None;
        for action in &mut recording.actions {
            *action = action.clamp(-ACTION_LIMIT, ACTION_LIMIT);
        }
        for reward in &mut recording.rewards {
            *reward = of_rewards.apply(*reward) / scaling.rewards.unwrap_or(1.0);
        }
        let warnings = Vec::new();
        Self { recording, rows, goes_on, past_goal, statistics, warnings, scaling }
    }

    /// Number of transitions, at least 1.
    #[allow(clippy::len_without_is_empty)] // Never empty.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Dimension of an observation.
    pub fn observation_dim(&self) -> usize {
        self.recording.observation_dim
    }

    /// Dimension of an action.
    pub fn action_dim(&self) -> usize {
        self.recording.action_dim
    }

    /// Offsets and scales of the normalization; rewards are scaled after the reward rule.
    pub fn scaling(&self) -> &Scaling {
        &self.scaling
    }

    /// Names of the dimensions of observations and actions.
    pub fn names(&self) -> &Names {
        &self.recording.names
    }

    /// Map of each dimension to mean 0 and standard deviation 1, or scale 0 if it is constant.
    pub fn standard_units(&self) -> Scaling {
        let all = &self.recording;
        let is_transition = |row: usize| all.kinds[row] == RowKind::Transition;
        let of = |values, width| Some(normalize::standard_units(values, width, is_transition));
        Scaling {
            observations: of(&all.observations, all.observation_dim),
            actions: of(&all.actions, all.action_dim),
            rewards: None,
        }
    }

    /// Statistics with the recorded rewards.
    pub fn statistics(&self) -> &Statistics {
        &self.statistics
    }

    /// Suspicious properties of the data, one sentence each.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Index of the next transition in the episode of `index < len()`.
    pub fn next(&self, index: u32) -> Option<u32> {
        let row = self.rows[index as usize];
        let is_next = self.rows.get(index as usize + 1) == Some(&(row + 1));
        (is_next && self.goes_on[row as usize]).then_some(index + 1)
    }

    /// Next action a', taken in s'. Unlike [`next`](Self::next), it includes steps without a
    /// transition.
    pub fn next_action(&self, index: u32) -> Option<&[f32]> {
        let row = self.rows[index as usize] as usize;
        self.goes_on[row].then(|| self.recording.action(row + 1))
    }

    /// Index range of each episode; together they cover all transitions.
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

    /// [`Self::episodes`] that start a recorded episode; the recording may continue after a goal.
    pub fn recorded_episodes(&self) -> Vec<Range<u32>> {
        let mut episodes = self.episodes();
        let row = |episode: &Range<u32>| self.rows[episode.start as usize] as usize;
        episodes.retain(|episode| !self.past_goal[row(episode)]);
        episodes
    }

    /// First index of each run of `length ≥ 1` consecutive transitions within an episode.
    pub fn window_starts(&self, length: u32) -> Vec<u32> {
        let starts = |episode: Range<u32>| {
            episode.start..(episode.end + 1).saturating_sub(length).max(episode.start)
        };
        self.episodes().into_iter().flat_map(starts).collect()
    }

    /// Copies the transitions at `indices` (below [`len`](Self::len)) into `batch`.
    pub fn gather(&self, indices: &[u32], batch: &mut Batch) {
        let all = &self.recording;
        batch.observations.clear();
        batch.actions.clear();
        batch.rewards.clear();
        batch.next_observations.clear();
        batch.masks.clear();
        batch.size = indices.len();
        for &index in indices {
            let row = self.rows[index as usize] as usize;
            let (state, next) = (all.observation(row), all.next_observation(row));
            batch.observations.extend_from_slice(state);
            batch.actions.extend_from_slice(all.action(row));
            batch.rewards.push(all.rewards[row]);
            batch.next_observations.extend_from_slice(next);
            batch.masks.push(f32::from(u8::from(!all.terminals[row])));
        }
    }
}

#[cfg(test)]
mod tests;
