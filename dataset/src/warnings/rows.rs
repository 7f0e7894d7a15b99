//! Rows that do not belong together: actions that copy observations, observations that rest, and
//! rows that were never written.

use std::f64::consts::PI;

use super::percent;
use crate::recording::{Recording, named};

const FEWEST: usize = 20;
/// Ratio of the units of action and observation: equal, percent, radians to degrees, and inverses.
const UNITS: [f64; 5] = [1.0, 100.0, 0.01, 180.0 / PI, PI / 180.0];
/// Tolerance of a copy, as a fraction of a typical step.
const OFF: f64 = 0.05;
/// Minimum fraction of copies among the steps.
const SHARE: f64 = 0.9;
/// Largest plausible fraction of steps at rest: action chunks of two steps give 0.5.
const MOST_AT_REST: f64 = 0.4;

/// Actions that copy a dimension of the same row's observation, in some unit. Steps that do not move
/// the dimension do not count: at rest, a position command equals the state.
pub(super) fn copied_actions(recording: &Recording) -> Option<String> {
    let rows = recording.some_that_go_on();
    let moving = (0..recording.observation_dim).map(|i| (i, moving(recording, &rows, i)));
    let moving = Vec::from_iter(moving.filter(|(_, (rows, _))| rows.len() >= FEWEST));
    let (mut actions, mut observations, mut least) = (Vec::new(), Vec::new(), 1.0_f64);
    for action in 0..recording.action_dim {
        let share = |(i, (rows, step)): &(usize, (Vec<usize>, f64))| {
            Some((*i, share_of_copies(recording, rows, *step, [*i, action])?))
        };
        if let Some((observation, share)) = moving.iter().find_map(share) {
            actions.push(action);
            observations.push(observation);
            least = least.min(share);
        }
    }
    (!actions.is_empty()).then(|| {
        format!(
            "array `actions`: {} copied from {} of the same row's observation (in {:.1} % of the steps at which these move); a robot \
             that follows its own state stands still: take what was commanded, or the state of the next row",
            named(&actions, &recording.names.actions),
            named(&observations, &recording.names.observations),
            100.0 * least
        )
    })
}

/// Rows in which dimension `i` moves by more than half of its typical step, and that step.
fn moving(recording: &Recording, rows: &[usize], i: usize) -> (Vec<usize>, f64) {
    let step = |row: usize| {
        f64::from(recording.observation(row + 1)[i]) - f64::from(recording.observation(row)[i])
    };
    let usual = (rows.iter().map(|row| step(*row).powi(2)).sum::<f64>() / rows.len() as f64).sqrt();
    let moves = |row: &usize| step(*row).abs() > usual / 2.0;
    (rows.iter().copied().filter(moves).collect(), usual)
}

/// Fraction of `rows` in which the action equals the observation in one unit, if large.
fn share_of_copies(
    recording: &Recording,
    rows: &[usize],
    step: f64,
    [observation, action]: [usize; 2],
) -> Option<f64> {
    let most_different = ((1.0 - SHARE) * rows.len() as f64) as usize;
    UNITS.into_iter().find_map(|unit| {
        let differs = |row: &&usize| {
            let copy = unit * f64::from(recording.observation(**row)[observation]);
            (f64::from(recording.action(**row)[action]) - copy).abs() > OFF * unit * step
        };
        let different = rows.iter().filter(differs).take(most_different + 1).count();
        (different <= most_different).then(|| 1.0 - different as f64 / rows.len() as f64)
    })
}

/// Observations that do not change although actions do.
pub(super) fn resting_observations(recording: &Recording) -> Option<String> {
    let acts = |row: &usize| {
        recording.is_step(*row)
            && recording.is_step(row + 1)
            && !recording.terminals[*row]
            && recording.action(*row) != recording.action(row + 1)
    };
    let acting = Vec::from_iter((0..recording.rows()).filter(acts));
    let share_at_rest = |rests: &dyn Fn(usize) -> bool| {
        let count = acting.iter().filter(|row| rests(**row)).count();
        let is_much = count as f64 > MOST_AT_REST * acting.len() as f64;
        (acting.len() >= FEWEST && is_much).then(|| percent(count, acting.len()))
    };
    let rests = |row: usize| recording.observation(row + 1) == recording.observation(row);
    if let Some(share) = share_at_rest(&rests) {
        return Some(format!(
            "array `observations`: does not change in {share} of the steps between which the action does; that of a chunk's start, or \
             of a sensor slower than control? record one at each step, or keep only the rows where it is new"
        ));
    }
    recording.next_observations.as_ref()?;
    let is_own = |row: usize| recording.next_observation(row) == recording.observation(row);
    let share = share_at_rest(&is_own)?;
    Some(format!(
        "array `next_observations`: is the observation of its own row in {share} of the steps; store the one after the step"
    ))
}

/// Zeros at the end of the file: arrays made larger than what was recorded into them.
pub(super) fn unwritten(recording: &Recording) -> Option<String> {
    let rows = recording.rows();
    // A recording that rests at 0 ends with a flag.
    let is_zero = |row: &usize| {
        let (state, action) = (recording.observation(*row), recording.action(*row));
        let numbers = state.iter().chain(action);
        let is_flagged = recording.terminals[*row] || recording.timeouts[*row];
        !is_flagged && recording.rewards[*row] == 0.0 && numbers.copied().all(|x| x == 0.0)
    };
    let zeros = (0..rows).rev().take_while(is_zero).count();
    (zeros >= FEWEST && zeros < rows).then(|| {
        format!(
            "array `observations`: 0 in the last {zeros} rows ({}), as are actions and rewards: rows that were never written? cut \
             all arrays after the last recorded step",
            percent(zeros, rows)
        )
    })
}
