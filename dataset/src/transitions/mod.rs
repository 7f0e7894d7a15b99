//! Transitions (s, a, r, s', mask) of a dataset.

pub mod hold_out;
mod rows;
pub mod sampler;
pub mod statistics;

use std::ops::Range;
use std::path::Path;
use std::sync::{PoisonError, RwLock, RwLockReadGuard};

use quad_kernels::scaling::Scaling;

use crate::error::{DatasetError, Problem};
use crate::files::{self, DatasetFile};
use crate::formats::ReadOptions;
use crate::formats::arrays::Arrays;
use crate::normalize;
use crate::online::{OnlineEpisode, Ranges};
use crate::recording::{Names, Recording, RowKind};
use crate::tables::environment::EnvironmentSpec;
use crate::tables::reward::{RewardRule, RewardScaling};
use crate::{checks, warnings};
use hold_out::HoldOut;
use rows::Rows;
use statistics::Statistics;

pub use rows::{Batch, Window};

/// Transitions for training: those of a dataset, in recorded order, and experience that grows.
///
/// The source's rows stay in place: transition i starts in row i and leads to row i + 1, unless the
/// format stores next observations.
///
/// An episode ends at a terminal, including a goal after which the recording continues, at a
/// timeout, and at a discontinuity. Rows without a transition (D4RL's timeouts) belong to no
/// episode, but provide the previous row's next action.
///
/// Indices below [`len`](Self::len) are the dataset's, those from there on experience, in the order
/// in which it was added. Statistics, scaling and episodes stay those of the dataset.
pub struct Transitions {
    dataset: Rows,
    experience: RwLock<Rows>,
    /// True after the goal was reached in the recorded episode.
    past_goal: Vec<bool>,
    statistics: Statistics,
    /// In the source's units.
    ranges: Ranges,
    warnings: Vec<String>,
    reward: RewardScaling,
    scaling: Scaling,
    /// For held-out transitions, the standard units of the training transitions.
    training_units: Option<Scaling>,
}

/// Training and validation transitions.
pub struct Split {
    /// Training transitions; statistics and scaling are of these alone, warnings of whole files.
    pub training: Transitions,
    /// Validation transitions, scaled like the training ones; `None` if no episode is held out.
    pub held_out: Option<Transitions>,
    /// Indices of the held-out episodes, from 0 in the order of the files.
    pub episodes: Vec<usize>,
    /// The files, without hashes; none for arrays in memory.
    pub files: Vec<DatasetFile>,
}

impl Transitions {
    /// Reads a dataset of any format by the rules in docs/data.md. Refuses numbers that are not
    /// finite, unnormalized actions outside [-1, 1], other dimensions or another environment than
    /// expected, and files with no transition or no end of an episode.
    pub fn read(path: impl AsRef<Path>, options: &ReadOptions) -> Result<Self, DatasetError> {
        Ok(Self::read_split(&[path], options, HoldOut::NONE)?.training)
    }

    /// Reads the files of a dataset, one after the other, and splits off validation episodes.
    /// Refuses files that do not fit each other.
    pub fn read_split(
        paths: &[impl AsRef<Path>],
        options: &ReadOptions,
        hold_out: HoldOut<'_>,
    ) -> Result<Split, DatasetError> {
        let environment = options.environment;
        let mut warnings = Vec::new();
        let check = |path: &Path, _: &_, recording: &Recording| {
            let doubts = warnings::file_warnings(recording, options).into_iter();
            warnings.extend(doubts.map(|doubt| format!("{}: {doubt}", path.display())));
            checks::accept(recording, environment, options.normalize.actions)
        };
        let (recording, files) = files::read(paths, environment, environment, options.task, check)?;
        let names = Vec::from_iter(files.iter().map(|file| file.path.to_string_lossy()));
        let names = names.join(", ");
        let doubts = warnings::number_warnings(&recording, options).into_iter();
        warnings.extend(doubts.map(|doubt| format!("{names}: {doubt}")));
        let split = Self::split(recording, options, hold_out);
        let mut split = split.map_err(|problem| DatasetError::new(names, problem))?;
        split.training.warnings.splice(..0, warnings);
        Ok(Split { files, ..split })
    }

    /// Checks and wraps arrays in memory, with unchanged rewards.
    pub fn of(arrays: Arrays) -> Result<Self, DatasetError> {
        let error = |problem| DatasetError::new("arrays in memory", problem);
        let (recording, options) = (arrays.into_recording().map_err(error)?, Default::default());
        checks::accept(&recording, None, false).map_err(error)?;
        let split = Self::split(recording, &options, HoldOut::NONE);
        Ok(split.map_err(error)?.training)
    }

    /// No dataset, for experience with these lengths of observations and actions.
    ///
    /// # Errors
    /// The rule scales rewards by a dataset's returns.
    pub fn without_data((o, a): (usize, usize), reward: RewardRule) -> Result<Self, Problem> {
        let reward = reward.scaling(&[]).ok_or(Problem::SameReturns)?;
        let none = Recording { observation_dim: o, action_dim: a, ..Recording::default() };
        Ok(Self::new(none, None, reward, Scaling::default()))
    }

    fn split(
        recording: Recording,
        options: &ReadOptions,
        hold_out: HoldOut<'_>,
    ) -> Result<Split, Problem> {
        let environment = options.environment;
        let (recording, held_out, episodes) = recording.hold_out(hold_out);
        if recording.transitions().next().is_none() {
            return Err(Problem::NoTransitions(recording.rows()));
        }
        let returns = recording.trajectory_returns();
        let rewards = options.reward.scaling(&returns).ok_or(Problem::SameReturns)?;
        let scaling = options.normalize.scaling(&recording, rewards);
        let new = |recording| Self::new(recording, environment, rewards, scaling.clone());
        let mut held_out = held_out.map(new).filter(|held_out| held_out.len() > 0);
        let mut training = new(recording);
        if matches!(hold_out, HoldOut::Fraction(fraction) if fraction > 0.0 && episodes.is_empty())
        {
            training.warnings.push("a single episode: none is held out".to_owned());
        }
        if let Some(held_out) = &mut held_out {
            held_out.training_units = Some(training.standard_units());
        }
        Ok(Split { training, held_out, episodes, files: Vec::new() })
    }

    fn new(
        recording: Recording,
        environment: Option<&EnvironmentSpec>,
        reward: RewardScaling,
        scaling: Scaling,
    ) -> Self {
        let (episodes, past_goal) = (recording.episodes(), recording.past_goal());
        let ranges = Ranges::new(&recording);
        let dataset = Rows::new(recording, reward, &scaling);
        Self {
            experience: RwLock::new(dataset.none()),
            past_goal,
            ranges,
            statistics: Statistics::new(environment, dataset.len(), &episodes),
            warnings: Vec::new(),
            dataset,
            reward,
            scaling,
            training_units: None,
        }
    }

    /// Number of the dataset's transitions; 0 only without a dataset.
    #[allow(clippy::len_without_is_empty)]
    pub fn len(&self) -> usize {
        self.dataset.len()
    }

    /// Dimension of an observation.
    pub fn observation_dim(&self) -> usize {
        self.dataset.recording.observation_dim
    }

    /// Dimension of an action.
    pub fn action_dim(&self) -> usize {
        self.dataset.recording.action_dim
    }

    /// Offsets and scales of the normalization; rewards are scaled after the reward rule.
    pub fn scaling(&self) -> &Scaling {
        &self.scaling
    }

    /// Names of the dimensions of observations and actions.
    pub fn names(&self) -> &Names {
        &self.dataset.recording.names
    }

    /// Map of each dimension of the training transitions to mean 0 and standard deviation 1, or scale
    /// 0 if it is constant.
    pub fn standard_units(&self) -> Scaling {
        if let Some(units) = &self.training_units {
            return units.clone();
        }
        let rows = &self.dataset.recording;
        let is_transition = |row: usize| rows.kinds[row] == RowKind::Transition;
        let units = |values, width| Some(normalize::standard_units(values, width, is_transition));
        Scaling {
            observations: units(&rows.observations, rows.observation_dim),
            actions: units(&rows.actions, rows.action_dim),
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

    /// Adds an online episode. Its rewards and numbers are transformed as the dataset's were,
    /// and actions beyond its range clipped; anything else that a dataset would be refused for is an
    /// error. Leaves out an episode with a number far outside the range of the dataset, if there is
    /// one, and names it.
    pub fn add_episode(&self, episode: OnlineEpisode<'_>) -> Result<Option<String>, Problem> {
        let recording = episode.recording(self.observation_dim(), self.action_dim())?;
        checks::accept(&recording, None, true)?;
        let far = self.ranges.far(&episode, self.names());
        if far.is_none() {
            let rows = Rows::new(recording, self.reward, &self.scaling);
            self.experience.write().unwrap_or_else(PoisonError::into_inner).extend(&rows);
        }
        Ok(far)
    }

    /// Number of transitions of experience.
    pub fn experience_len(&self) -> usize {
        self.experience().len()
    }

    /// Index range of each episode that was added.
    pub fn experience_episodes(&self) -> Vec<Range<u32>> {
        let len = self.len() as u32;
        let after = |episode: Range<u32>| len + episode.start..len + episode.end;
        self.experience().episodes().into_iter().map(after).collect()
    }

    fn experience(&self) -> RwLockReadGuard<'_, Rows> {
        self.experience.read().unwrap_or_else(PoisonError::into_inner)
    }

    /// Next action a', taken in s', also by a step without a transition.
    pub fn next_action(&self, index: u32) -> Option<&[f32]> {
        self.dataset.next_action(index)
    }

    /// True if the transition at `index < len()` ends its episode for good: it has no future reward.
    pub fn terminates(&self, index: u32) -> bool {
        self.dataset.terminates(index)
    }

    /// Index range of each of the dataset's episodes; together they cover all its transitions.
    pub fn episodes(&self) -> Vec<Range<u32>> {
        self.dataset.episodes()
    }

    /// [`Self::episodes`] that start a recorded episode; the recording may continue after a goal.
    pub fn recorded_episodes(&self) -> Vec<Range<u32>> {
        let mut episodes = self.episodes();
        let row = |episode: &Range<u32>| self.dataset.starts[episode.start as usize] as usize;
        episodes.retain(|episode| !self.past_goal[row(episode)]);
        episodes
    }

    /// Copies the transitions at `indices`.
    pub fn gather(&self, indices: &[u32]) -> Batch {
        self.gather_windows(indices, Window::ONE)
    }

    /// Copies the windows that begin with the transitions at `indices`.
    pub fn gather_windows(&self, indices: &[u32], window: Window) -> Batch {
        let experience = self.experience();
        let (n, o) = (indices.len(), window.history * self.observation_dim());
        let mut batch = Batch {
            observations: Vec::with_capacity(n * o),
            actions: Vec::with_capacity(n * window.length * self.action_dim()),
            rewards: Vec::with_capacity(n),
            next_observations: Vec::with_capacity(n * o),
            masks: Vec::with_capacity(n),
            steps: Vec::with_capacity(n),
        };
        for &index in indices {
            match index.checked_sub(self.len() as u32) {
                None => self.dataset.copy_to(&mut batch, index, window),
                Some(place) => experience.copy_to(&mut batch, place, window),
            }
        }
        batch
    }
}

#[cfg(test)]
mod tests;
