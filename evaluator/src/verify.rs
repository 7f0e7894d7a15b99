//! Replays a recorded file one step at a time from its own states, and says how far the simulation is from it.

use std::path::Path;

use quad_dataset::{DatasetError, EnvironmentSpec, RecordedRows, Row};
use rayon::prelude::*;
use serde::Serialize;
use thiserror::Error;

use crate::environment::{self, Environment, EnvironmentError};

/// Rewards differ when they are further apart than this, relative to 1 or to the recorded one, whichever is larger.
///
/// Files hold float32. A state rounded to it moves the reward of a Hopper step by 1e-6, and by 2e-4 in the rare one where a
/// contact begins or ends on the edge; another rule or another contact model moves many rewards by more than 1e-2.
const REWARD_TOLERANCE: f64 = 1e-3;

/// How a file compares with the simulation.
#[derive(Debug, Serialize)]
pub struct Report {
    /// Rows replayed.
    pub transitions: usize,
    /// The largest error of each row's next observation, over its values.
    pub obs_error: ObservationError,
    /// Errors of the rewards.
    pub reward_error: RewardError,
    /// Rows whose reward is not the recorded one, beyond what float32 explains.
    pub rewards_differ: usize,
    /// Rows that are terminal in one and not in the other.
    pub terminals_differ: usize,
}

/// Absolute errors of the next observation.
#[derive(Debug, Serialize)]
pub struct ObservationError {
    /// Half of the rows are below it.
    pub median: f64,
    /// 99 % of the rows are below it.
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
    /// There is nothing to replay.
    #[error("{0}: no rows")]
    Empty(String),
}

/// Replays every row of the file at `path`: from its qpos and qvel, with its action, for one step.
pub fn verify(path: &Path, spec: &'static EnvironmentSpec) -> Result<Report, VerifyError> {
    let rows = RecordedRows::read(path, spec)?;
    if rows.is_empty() {
        return Err(VerifyError::Empty(path.display().to_string()));
    }
    let threads = rayon::current_num_threads();
    let share = rows.len().div_ceil(threads);
    let mut environments =
        (0..threads).map(|_| environment::make(spec, 0)).collect::<Result<Vec<_>, EnvironmentError>>()?;
    let errors: Vec<RowError> = environments
        .par_iter_mut()
        .enumerate()
        .flat_map_iter(|(thread, environment)| {
            let rows = &rows;
            let own = thread * share..rows.len().min((thread + 1) * share);
            own.map(move |i| replay(environment.as_mut(), &rows.row(i)))
        })
        .collect();
    Ok(summarise(&errors))
}

struct RowError {
    observation: f64,
    reward: f64,
    reward_differs: bool,
    terminal_differs: bool,
}

fn replay(environment: &mut dyn Environment, row: &Row<'_>) -> RowError {
    environment.set_state(row.qpos, row.qvel);
    let action: Vec<f32> = row.action.iter().map(|&value| value as f32).collect();
    let step = environment.step(&action);
    let apart = environment.observation().iter().zip(row.next_observation).map(|(ours, theirs)| (ours - theirs).abs());
    let reward = (step.reward - row.reward).abs();
    RowError {
        observation: apart.fold(0.0, f64::max),
        reward,
        reward_differs: reward > REWARD_TOLERANCE * row.reward.abs().max(1.0),
        terminal_differs: step.terminated != row.terminal,
    }
}

fn summarise(errors: &[RowError]) -> Report {
    let mut sorted: Vec<f64> = errors.iter().map(|row| row.observation).collect();
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share).round() as usize];
    Report {
        transitions: errors.len(),
        obs_error: ObservationError { median: at(0.5), p99: at(0.99), max: at(1.0) },
        reward_error: RewardError { max: errors.iter().map(|row| row.reward).fold(0.0, f64::max) },
        rewards_differ: errors.iter().filter(|row| row.reward_differs).count(),
        terminals_differ: errors.iter().filter(|row| row.terminal_differs).count(),
    }
}
