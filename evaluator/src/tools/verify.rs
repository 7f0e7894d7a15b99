//! Replays a recorded file one step at a time from its own states, and measures how far the simulation is from it.

use std::path::{Path, PathBuf};

use quad_dataset::environment::{UnknownEnvironment, find};
use quad_dataset::{
    DatasetError, EnvironmentSpec, Problem, RecordedRows, Row, environments_of_its_sizes, recorded_environment,
};
use rayon::prelude::*;
use serde::Serialize;
use thiserror::Error;

use crate::sim::{self, EnvironmentError, Simulation};

/// Rewards differ if their distance is larger than this (relative to 1 or to the recorded reward, whichever is larger) and
/// larger than that of the next observation.
///
/// Files hold float32. Rounding a state to it changes the reward of a step by 1e-6; in a rare step, where a contact begins or
/// ends, by up to 1e-2, and a velocity by far more (row 40816 of a Walker2d file: 8e-3 and 0.17). Another reward rule changes
/// the reward of many steps whose next observation is right.
const REWARD_TOLERANCE: f64 = 1e-3;

/// How a file compares with the simulation.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Environment of the replay.
    pub environment: &'static str,
    /// Rows replayed.
    pub transitions: usize,
    /// Rows whose next observation is known. In a file without next_observations it is the observation of the following row,
    /// so it is unknown where an episode ends.
    pub compared: usize,
    /// The largest error of each compared row's next observation, over its values.
    pub obs_error: ObservationError,
    /// Errors of the rewards.
    pub reward_error: RewardError,
    /// Rows whose reward differs from the recorded one by more than float32 explains.
    pub rewards_differ: usize,
    /// Rows that are terminal only in the file or only in the simulation. A terminal step at the time limit is often recorded
    /// as a timeout only, which is no difference.
    pub terminals_differ: usize,
}

/// Absolute errors of the next observation.
#[derive(Debug, Serialize)]
pub struct ObservationError {
    /// Half of the rows have a smaller error.
    pub median: f64,
    /// 99 % of the rows have a smaller error.
    pub p99: f64,
    /// The worst row.
    pub max: f64,
}

/// Absolute errors of the reward.
#[derive(Debug, Serialize)]
pub struct RewardError {
    /// The worst row.
    pub max: f64,
}

/// Why a file could not be compared.
#[derive(Debug, Error)]
pub enum VerifyError {
    /// The file could not be read, or lacks what a replay needs.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The environment could not be made.
    #[error(transparent)]
    Environment(#[from] EnvironmentError),
    /// The file has no row to replay.
    #[error("{0}: no rows with a next observation")]
    Empty(PathBuf),
    /// The file names an unknown environment.
    #[error("{path}: recorded in another environment")]
    Unknown {
        /// The file.
        path: PathBuf,
        /// The environment's name.
        source: UnknownEnvironment,
    },
    /// The file names no environment, and its sizes fit several or none.
    #[error("{path}: does not say which environment it was recorded in, and its sizes fit {}", sizes(fitting))]
    Unnamed {
        /// The file.
        path: PathBuf,
        /// Names of the environments of these sizes.
        fitting: Vec<&'static str>,
    },
}

impl VerifyError {
    /// What to do about it.
    pub fn hint(&self) -> String {
        match self {
            Self::Dataset(error) if !matches!(error.problem, Problem::Missing { .. }) => error.hint(),
            Self::Unknown { .. } | Self::Unnamed { .. } => "--env NAME says where it was recorded".to_owned(),
            _ => "a file that can be replayed is what `evaluator collect --env hopper --out FILE` writes".to_owned(),
        }
    }
}

fn sizes(fitting: &[&str]) -> String {
    if fitting.is_empty() { "none".to_owned() } else { fitting.join(", ") }
}

/// The environment of a file: the one that it names or, if it names none, the only one of its sizes.
pub fn environment_of(path: &Path) -> Result<&'static EnvironmentSpec, VerifyError> {
    if let Some(name) = recorded_environment(path)? {
        return find(&name).map_err(|source| VerifyError::Unknown { path: path.into(), source });
    }
    match environments_of_its_sizes(path)?[..] {
        [only] => Ok(only),
        ref fitting => {
            let fitting = fitting.iter().map(|spec| spec.name.as_str()).collect();
            Err(VerifyError::Unnamed { path: path.into(), fitting })
        }
    }
}

/// Replays every row of the file at `path`: sets its qpos and qvel, and takes one step with its action.
pub fn verify(path: &Path, spec: &'static EnvironmentSpec) -> Result<Report, VerifyError> {
    let rows = RecordedRows::read(path, spec)?;
    let threads = rayon::current_num_threads();
    let share = rows.len().div_ceil(threads);
    let mut environments = (0..threads).map(|_| sim::make(spec, 0)).collect::<Result<Vec<_>, EnvironmentError>>()?;
    let errors: Vec<RowError> = environments
        .par_iter_mut()
        .enumerate()
        .flat_map_iter(|(thread, environment)| {
            let rows = &rows;
            let own = thread * share..rows.len().min((thread + 1) * share);
            own.map(move |i| replay(environment, &rows.row(i), rows.goal(i)))
        })
        .collect();
    summarise(spec, &errors).ok_or_else(|| VerifyError::Empty(path.into()))
}

struct RowError {
    observation: Option<f64>,
    reward: f64,
    reward_differs: bool,
    terminal_differs: bool,
}

fn replay(environment: &mut Simulation, row: &Row<'_>, goal: Option<&[f64]>) -> RowError {
    if let Some(goal) = goal {
        environment.set_goal(goal);
    }
    environment.set_state(row.qpos, row.qvel);
    let action: Vec<f32> = row.action.iter().map(|&value| value as f32).collect();
    let step = environment.step(&action);
    let apart = environment.observation().iter().zip(row.next_observation).map(|(ours, theirs)| (ours - theirs).abs());
    let observation = apart.reduce(f64::max);
    let reward = (step.reward - row.reward).abs();
    let explained = (REWARD_TOLERANCE * row.reward.abs().max(1.0)).max(observation.unwrap_or(0.0));
    let cut_off = row.timeout && !row.terminal;
    RowError {
        observation,
        reward,
        reward_differs: reward > explained,
        terminal_differs: step.terminated != row.terminal && !cut_off,
    }
}

/// `None` if there is no row to compare.
fn summarise(spec: &'static EnvironmentSpec, errors: &[RowError]) -> Option<Report> {
    let mut sorted: Vec<f64> = errors.iter().filter_map(|row| row.observation).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    let at = |share: f64| sorted[(last as f64 * share).round() as usize];
    Some(Report {
        environment: &spec.name,
        transitions: errors.len(),
        compared: sorted.len(),
        obs_error: ObservationError { median: at(0.5), p99: at(0.99), max: at(1.0) },
        reward_error: RewardError { max: errors.iter().map(|row| row.reward).fold(0.0, f64::max) },
        rewards_differ: errors.iter().filter(|row| row.reward_differs).count(),
        terminals_differ: errors.iter().filter(|row| row.terminal_differs).count(),
    })
}
