//! Checks that refuse a dataset before training.

use crate::error::{Problem, RowProblem};
use crate::recording::{ACTION_NAMES, OBSERVATION_NAMES, Recording, named};
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
    let outside = || actions_outside(recording).filter(|_| !normalized);
    let problem = problems(recording, environment).into_iter().next();
    problem.or_else(outside).map_or(Ok(()), Err)
}

/// Problems of a recording as data of an environment, most severe first.
pub(crate) fn problems(
    recording: &Recording,
    environment: Option<&EnvironmentSpec>,
) -> Vec<Problem> {
    let rows = recording.rows();
    let (o, a) = (recording.observation_dim, recording.action_dim);
    let mut problems = Vec::new();
    if recording.transitions().next().is_none() {
        problems.push(Problem::NoTransitions(rows));
    }
    if let Some(spec) = environment.filter(|_| rows > 0) {
        for (array, width, expected) in
            [("observations", o, spec.observation_dim), ("actions", a, spec.action_dim)]
        {
            if width != expected {
                problems.push(Problem::Width(array, width, spec.name.clone(), expected));
            }
        }
    }
    let names = &recording.names;
    problems.extend(wrong_name(OBSERVATION_NAMES, &names.observations));
    problems.extend(wrong_name(ACTION_NAMES, &names.actions));
    let next_observations = recording.next_observations.as_deref().unwrap_or_default();
    for (column, values, width) in [
        ("observations", &*recording.observations, o),
        ("next_observations", next_observations, o),
        ("actions", &recording.actions, a),
        ("rewards", &recording.rewards, 1),
    ] {
        // A final state has nothing but an observation.
        let wrong = wrong_numbers(values, width, |row, value| {
            let counts = column == "observations" || recording.is_step(row);
            (counts && !value.is_finite()).then_some(RowProblem::NotFinite(value))
        });
        problems.extend(first(recording, column, wrong));
    }
    problems.extend(strays(recording).and_then(|(problem, refused)| refused.then_some(problem)));
    let limit = environment.map_or(0, |environment| environment.max_episode_steps);
    if rows > limit && !recording.ends.contains(&true) && !recording.terminals.contains(&true) {
        problems.push(Problem::Endless(rows));
    }
    problems
}

/// The first name that is empty, has control characters, or is that of several columns.
fn wrong_name(attribute: &'static str, names: &[String]) -> Option<Problem> {
    names.iter().find_map(|name| {
        let same = Vec::from_iter((0..names.len()).filter(|i| names[*i] == *name));
        let is_text = !name.trim().is_empty() && !name.contains(char::is_control);
        let columns = named(&same, &[]);
        (!is_text || same.len() > 1).then(|| Problem::Name(attribute, name.clone(), columns))
    })
}

/// Rows whose stored next observation is not the following row's, and true if they are refused.
/// D4RL files are refused above [`MOST_STRAYS`], because training uses the following row.
pub(crate) fn strays(recording: &Recording) -> Option<(Problem, bool)> {
    let strays = Vec::from_iter(recording.inside().filter(|&row| recording.jumps(row)));
    let most = MOST_STRAYS * recording.inside().count() as f64;
    let refused = recording.unused_next_observations.is_some() && strays.len() as f64 > most;
    let wrong = strays.into_iter().map(|row| (row, RowProblem::Stray));
    Some((first(recording, "next_observations", wrong)?, refused))
}

/// Actions outside [-1, 1]; refused unless actions are normalized.
pub(crate) fn actions_outside(recording: &Recording) -> Option<Problem> {
    let outside = wrong_numbers(&recording.actions, recording.action_dim, |row, value| {
        let is_outside = value.is_finite() && value.abs() > 1.0 + ACTION_TOLERANCE;
        (recording.is_step(row) && is_outside).then_some(RowProblem::ActionOutside(value))
    });
    first(recording, "actions", outside)
}

/// Each row with a wrong number, and the problem of the first.
fn wrong_numbers(
    values: &[f32],
    width: usize,
    problem: impl Fn(usize, f32) -> Option<RowProblem>,
) -> impl Iterator<Item = (usize, RowProblem)> {
    let rows = values.chunks_exact(width.max(1)).enumerate();
    rows.filter_map(move |(row, values)| {
        Some((row, values.iter().find_map(|value| problem(row, *value))?))
    })
}

/// The problem of the first of some wrong rows, with their number.
pub(crate) fn first(
    recording: &Recording,
    column: &str,
    mut wrong: impl Iterator<Item = (usize, RowProblem)>,
) -> Option<Problem> {
    let (row, problem) = wrong.next()?;
    let (array, row) = recording.place(column, row);
    Some(Problem::Rows(array, row, 1 + wrong.count(), problem))
}
