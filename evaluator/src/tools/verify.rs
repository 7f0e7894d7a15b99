//! Replays a recorded file one step at a time from its own states, and measures how far the
//! simulation is from it.

use std::fmt;
use std::path::Path;

use anyhow::{Context, anyhow};
use quad_dataset::environment::find;
use quad_dataset::{
    ArrayProblem, DatasetError, EnvironmentSpec, Problem, RecordedRows, RecordedStep,
    matching_environments, recorded_environment,
};
use quad_runtime::Hint;
use rayon::prelude::*;
use serde::Serialize;

use crate::sim::{self, EnvironmentError, Simulation};

/// Rewards differ if their distance is larger than this (relative to 1 or to the recorded reward,
/// whichever is larger) and larger than that of the next observation.
///
/// Files hold float32. Rounding a state to it changes the reward of a step by 1e-6; in a rare step,
/// where a contact begins or ends, by up to 1e-2, and a velocity by far more (row 40816 of a
/// Walker2d file: 8e-3 and 0.17). Another reward rule changes the reward of many steps whose next
/// observation is right.
const REWARD_TOLERANCE: f64 = 1e-3;

/// Comparison of a file with the simulation.
#[derive(Debug, Serialize)]
pub struct Comparison {
    pub environment: &'static str,
    /// Rows replayed.
    pub transitions: usize,
    /// Rows whose next observation is known. In a file without next_observations it is the
    /// observation of the following row, so it is unknown where an episode ends.
    pub compared: usize,
    /// The largest error of each compared row's next observation, over its values.
    pub obs_error: Errors,
    pub reward_error: LargestError,
    /// Rows whose reward differs from the recorded one by more than float32 explains.
    pub rewards_differ: usize,
    /// Rows that are terminal only in the file or only in the simulation. A terminal step at the
    /// time limit is often recorded as a timeout only, which is no difference.
    pub terminals_differ: usize,
}

/// Absolute errors over the rows.
#[derive(Debug, Serialize)]
pub struct Errors {
    pub median: f64,
    pub p99: f64,
    pub max: f64,
}

#[derive(Debug, Serialize)]
pub struct LargestError {
    pub max: f64,
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (transitions, compared, errors) = (self.transitions, self.compared, &self.obs_error);
        write!(
            f,
            "environment        {}
transitions        {transitions}, of which {compared} have a next observation to compare
observation error  median {:.1e}, p99 {:.1e}, max {:.1e}
reward error       max {:.1e}
rewards differ     {}
terminals differ   {}",
            self.environment,
            errors.median,
            errors.p99,
            errors.max,
            self.reward_error.max,
            self.rewards_differ,
            self.terminals_differ
        )
    }
}

const OTHER_FILE: &str =
    "`evaluator collect --env hopper --out FILE` writes a file that can be replayed";
const ENVIRONMENT: &str = "name its environment with --env NAME";

fn hint(error: &DatasetError) -> String {
    match error.problem {
        Problem::Array(_, ArrayProblem::Missing(_)) => OTHER_FILE.to_owned(),
        _ => error.hint(),
    }
}

/// The environment of a file: the one that it names or, if it names none, the only one of its
/// sizes.
pub fn environment_of(path: &Path) -> anyhow::Result<&'static EnvironmentSpec> {
    let file = path.display();
    if let Some(name) = recorded_environment(path).hint_of(hint)? {
        let problem = || format!("{file}: recorded in an unknown environment");
        return find(&name).with_context(problem).hint(ENVIRONMENT);
    }
    let fitting = matching_environments(path).hint_of(hint)?;
    let names = match &fitting[..] {
        [only] => return Ok(only),
        [] => "none".to_owned(),
        several => Vec::from_iter(several.iter().map(|spec| spec.name.as_str())).join(", "),
    };
    let problem = "does not say which environment it was recorded in, and its sizes fit";
    Err(anyhow!("{file}: {problem} {names}")).hint(ENVIRONMENT)
}

/// Replays every row of the file at `path`: sets its qpos and qvel, and takes one step with its
/// action.
pub fn verify(path: &Path, spec: &'static EnvironmentSpec) -> anyhow::Result<Comparison> {
    let rows = RecordedRows::read(path, spec).hint_of(hint)?;
    let threads = rayon::current_num_threads();
    let share = rows.len().div_ceil(threads);
    let replay_share = |i| -> Result<Vec<RowError>, EnvironmentError> {
        let mut environment = sim::make(spec, 0)?;
        let own = i * share..rows.len().min((i + 1) * share);
        Ok(own.map(|i| replay(&mut environment, &rows.row(i), rows.goal(i))).collect())
    };
    let shares = (0..threads).into_par_iter().map(replay_share);
    let errors = shares.collect::<Result<Vec<_>, _>>()?.concat();
    summarize(spec, &errors)
        .with_context(|| format!("{}: no rows with a next observation", path.display()))
        .hint(OTHER_FILE)
}

#[derive(Clone)]
struct RowError {
    observation: Option<f64>,
    reward: f64,
    reward_differs: bool,
    terminal_differs: bool,
}

fn replay(environment: &mut Simulation, row: &RecordedStep<'_>, goal: Option<&[f64]>) -> RowError {
    if let Some(goal) = goal {
        environment.set_goal(goal);
    }
    environment.set_state(row.qpos, row.qvel);
    let action: Vec<f32> = row.action.iter().map(|&value| value as f32).collect();
    let step = environment.step(&action);
    let compared = environment.observation().iter().zip(row.next_observation);
    let observation = compared.map(|(ours, theirs)| (ours - theirs).abs()).reduce(f64::max);
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
fn summarize(spec: &'static EnvironmentSpec, errors: &[RowError]) -> Option<Comparison> {
    let mut sorted: Vec<f64> = errors.iter().filter_map(|row| row.observation).collect();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    let percentile = |share: f64| sorted[(last as f64 * share).round() as usize];
    let (median, p99, max) = (percentile(0.5), percentile(0.99), percentile(1.0));
    let rewards = errors.iter().map(|row| row.reward);
    Some(Comparison {
        environment: &spec.name,
        transitions: errors.len(),
        compared: sorted.len(),
        obs_error: Errors { median, p99, max },
        reward_error: LargestError { max: rewards.fold(0.0, f64::max) },
        rewards_differ: errors.iter().filter(|row| row.reward_differs).count(),
        terminals_differ: errors.iter().filter(|row| row.terminal_differs).count(),
    })
}
