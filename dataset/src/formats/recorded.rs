//! D4RL files with simulator states, as `evaluator collect` writes them, read without conversion.

use std::path::Path;

use crate::error::{DatasetError, Problem, RowProblem};
use crate::formats::hdf5_file::Hdf5File;
use crate::tables::environment::{self, EnvironmentSpec};

/// Recorded step in float64.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RecordedStep<'a> {
    /// s, before the step.
    pub observation: &'a [f64],
    /// a, as applied.
    pub action: &'a [f64],
    /// s', after the step and before any reset; empty if unknown.
    pub next_observation: &'a [f64],
    /// Reward r.
    pub reward: f64,
    /// True if the episode terminated in s'.
    pub terminal: bool,
    /// True if the time limit truncated the episode after this step.
    pub timeout: bool,
    /// MuJoCo's positions before the step.
    pub qpos: &'a [f64],
    /// MuJoCo's velocities before the step.
    pub qvel: &'a [f64],
}

/// Rows of a D4RL file with simulator states, and goals in mazes.
pub struct RecordedRows {
    environment: &'static EnvironmentSpec,
    observations: Vec<f64>,
    actions: Vec<f64>,
    /// Absent in D4RL's AntMaze files.
    next_observations: Option<Vec<f64>>,
    rewards: Vec<f64>,
    terminals: Vec<bool>,
    timeouts: Vec<bool>,
    qpos: Vec<f64>,
    qvel: Vec<f64>,
    goals: Option<Vec<f64>>,
}

/// Simulations whose dimensions match those of the file, each by the environment of its name.
pub fn matching_environments(
    path: impl AsRef<Path>,
) -> Result<Vec<&'static EnvironmentSpec>, DatasetError> {
    let file = Hdf5File::open(path.as_ref())?;
    let width = |array| match file.size(array) {
        Ok((_, width)) => Ok(width),
        Err(problem) => Err(DatasetError::new(file.path(), problem)),
    };
    let sizes = (width("observations")?, width("actions")?);
    let specs = environment::specs().iter().filter(|spec| spec.simulation() == spec.name);
    Ok(specs.filter(|spec| spec.sizes() == sizes).collect())
}

const GOAL_DIM: usize = 2;

impl RecordedRows {
    /// Reads a file recorded in `environment`.
    pub fn read(
        path: impl AsRef<Path>,
        environment: &'static EnvironmentSpec,
    ) -> Result<Self, DatasetError> {
        let file = Hdf5File::open(path.as_ref())?;
        let table = |array: &str, rows, width| -> Result<_, Problem> {
            let values: Vec<f64> = file.table(array, rows, width)?;
            match values.iter().position(|value| !value.is_finite()) {
                None => Ok(values),
                Some(i) => Err(RowProblem::NotFinite(values[i] as f32).in_row(array, i / width)),
            }
        };
        let read = || -> Result<_, Problem> {
            let (rows, _) = file.size("actions")?;
            let o = environment.observation_dim;
            let stored = file.has("next_observations");
            let stored = stored.then(|| table("next_observations", rows, o));
            let goals = || table("infos/goal", rows, GOAL_DIM);
            let goals = environment.maze.map(|_| goals());
            Ok(Self {
                environment,
                observations: table("observations", rows, o)?,
                actions: table("actions", rows, environment.action_dim)?,
                next_observations: stored.transpose()?,
                rewards: table("rewards", rows, 1)?,
                terminals: file.flags("terminals", rows)?,
                timeouts: file.flags("timeouts", rows)?,
                qpos: table("infos/qpos", rows, environment.qpos_dim)?,
                qvel: table("infos/qvel", rows, environment.qvel_dim)?,
                goals: goals.transpose()?,
            })
        };
        read().map_err(|problem| DatasetError::new(file.path(), problem))
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.rewards.len()
    }

    /// True without rows.
    pub fn is_empty(&self) -> bool {
        self.rewards.is_empty()
    }

    /// Row `i < len()`.
    pub fn row(&self, i: usize) -> RecordedStep<'_> {
        let spec = self.environment;
        let columns = |width: usize| i * width..(i + 1) * width;
        RecordedStep {
            observation: &self.observations[columns(spec.observation_dim)],
            action: &self.actions[columns(spec.action_dim)],
            next_observation: self.next_observation(i),
            reward: self.rewards[i],
            terminal: self.terminals[i],
            timeout: self.timeouts[i],
            qpos: &self.qpos[columns(spec.qpos_dim)],
            qvel: &self.qvel[columns(spec.qvel_dim)],
        }
    }

    /// Goal at row `i` if the file has goals: x and y.
    pub fn goal(&self, i: usize) -> Option<&[f64]> {
        let goals = self.goals.as_ref()?;
        Some(&goals[i * GOAL_DIM..][..GOAL_DIM])
    }

    /// Stored next observation, or the following row's if no episode ends in between.
    fn next_observation(&self, i: usize) -> &[f64] {
        let width = self.environment.observation_dim;
        match &self.next_observations {
            Some(stored) => &stored[i * width..][..width],
            None if self.terminals[i] || self.timeouts[i] || i + 1 == self.len() => &[],
            None => &self.observations[(i + 1) * width..][..width],
        }
    }

    /// Iterates over all rows.
    pub fn iter(&self) -> impl Iterator<Item = RecordedStep<'_>> {
        (0..self.len()).map(|i| self.row(i))
    }
}
