//! Checks that refuse a dataset before training.

use crate::error::Problem;
use crate::recording::{Recording, RowKind};
use crate::tables::environment::EnvironmentSpec;

/// Distance outside [-1, 1] that rounding explains; such actions are clipped.
const ACTION_TOLERANCE: f32 = 1e-3;

/// Share of discontinuous rows allowed. D4RL's replay buffers reach 0.001; shuffled rows nearly 1.
const MOST_STRAYS: f64 = 0.01;

/// Refuses a recording with a problem. Actions must be within [-1, 1] unless they are `normalized`.
pub(crate) fn accept(
    recording: &Recording,
    environment: Option<&EnvironmentSpec>,
    normalized: bool,
) -> Result<(), Problem> {
    let outside = if normalized { None } else { actions_outside(recording) };
    let mut problems = problems(recording, environment).into_iter().chain(outside);
    problems.next().map_or(Ok(()), Err)
}

/// Problems of a recording as data of an environment, most severe first.
pub(crate) fn problems(
    recording: &Recording,
    environment: Option<&EnvironmentSpec>,
) -> Vec<Problem> {
    let rows = recording.rows();
    let mut problems = Vec::new();
    if recording.transitions().next().is_none() {
        problems.push(Problem::NoTransitions { rows });
    }
    if let Some(environment) = environment {
        let width = |array, found, expected| {
            let environment = environment.name.clone();
            (found != expected && rows > 0).then_some(Problem::Width {
                array,
                found,
                expected,
                environment,
            })
        };
        problems.extend(width(
            "observations",
            recording.observation_dim,
            environment.observation_dim,
        ));
        problems.extend(width("actions", recording.action_dim, environment.action_dim));
    }
    let (o, a) = (recording.observation_dim, recording.action_dim);
    let next_observations = recording.next_observations.as_deref().unwrap_or_default();
    let is_step = |row: usize| recording.kinds[row] != RowKind::LastState;
    problems.extend(not_finite(recording, "observations", &recording.observations, o, |_| true));
    problems.extend(not_finite(recording, "next_observations", next_observations, o, |_| true));
    problems.extend(not_finite(recording, "actions", &recording.actions, a, is_step));
    problems.extend(not_finite(recording, "rewards", &recording.rewards, 1, is_step));
    problems.extend(strays(recording).and_then(|(problem, refused)| refused.then_some(problem)));
    let limit = environment.map_or(0, |environment| environment.max_episode_steps);
    if rows > limit && !recording.ends.contains(&true) && !recording.terminals.contains(&true) {
        problems.push(Problem::Endless { rows });
    }
    problems
}

/// Rows whose stored next observation is not the following row's, and true if they are refused.
/// D4RL files are refused above [`MOST_STRAYS`], because training uses the following row.
pub(crate) fn strays(recording: &Recording) -> Option<(Problem, bool)> {
    let unused = recording.unused_next_observations.as_ref();
    let stored = recording.next_observations.as_ref().or(unused)?;
    let mut strays = recording.inside().filter(|&row| recording.jumps(stored, row));
    let (row, rows) = (strays.next()?, 1 + strays.count());
    let refused = unused.is_some() && rows as f64 > MOST_STRAYS * recording.inside().count() as f64;
    Some((Problem::Stray { row, rows }, refused))
}

fn not_finite(
    recording: &Recording,
    column: &str,
    values: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool,
) -> Option<Problem> {
    let (row, value, rows) = first(values, width, |row, value| counts(row) && !value.is_finite())?;
    let (array, row) = recording.place(column, row);
    Some(Problem::NotFinite { array, row, value, rows })
}

/// Actions outside [-1, 1]; refused unless actions are normalized.
pub(crate) fn actions_outside(recording: &Recording) -> Option<Problem> {
    let is_outside = |row: usize, value: f32| {
        let is_step = recording.kinds[row] != RowKind::LastState;
        is_step && value.is_finite() && value.abs() > 1.0 + ACTION_TOLERANCE
    };
    let (row, value, rows) = first(&recording.actions, recording.action_dim, is_outside)?;
    let (array, row) = recording.place("actions", row);
    Some(Problem::ActionOutside { array, row, value, rows })
}

/// Row and value of the first wrong number, and the count of such rows.
fn first(
    values: &[f32],
    width: usize,
    is_wrong: impl Fn(usize, f32) -> bool,
) -> Option<(usize, f32, usize)> {
    let wrong_in = |(row, values): (usize, &[f32])| {
        let value = values.iter().find(|&&value| is_wrong(row, value))?;
        Some((row, *value))
    };
    let mut wrong = values.chunks_exact(width.max(1)).enumerate().filter_map(wrong_in);
    let (row, value) = wrong.next()?;
    Some((row, value, 1 + wrong.count()))
}
