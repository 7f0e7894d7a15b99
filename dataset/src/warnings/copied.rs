//! Actions that copy a dimension of the same row's observation, in some unit.

use std::f64::consts::PI;

use crate::recording::{Recording, named};

/// Ratio of the units of action and observation: equal, percent, radians to degrees, and inverses.
const UNITS: [f64; 5] = [1.0, 100.0, 0.01, 180.0 / PI, PI / 180.0];
const FEWEST: usize = 20;
/// Tolerance of a copy, as a fraction of a typical step.
const OFF: f64 = 0.05;
/// Minimum fraction of copies among the steps.
const SHARE: f64 = 0.9;

/// Ignores steps that do not move the dimension: at rest, a position command equals the state.
pub(super) fn actions(recording: &Recording) -> Option<String> {
    let rows = recording.some_that_go_on();
    let (mut actions, mut observations, mut least) = (Vec::new(), Vec::new(), 1.0_f64);
    let moving: Vec<(Vec<usize>, f64)> =
        (0..recording.observation_dim).map(|i| moving(recording, &rows, i)).collect();
    for action in 0..recording.action_dim {
        let share = |i: &usize| Some((*i, share_of_copies(recording, &moving[*i], *i, action)?));
        if let Some((observation, share)) = (0..recording.observation_dim).find_map(|i| share(&i)) {
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
    (rows.iter().copied().filter(|row| step(*row).abs() > usual / 2.0).collect(), usual)
}

/// Fraction of the moving rows in which the action equals the observation in one unit, if large.
fn share_of_copies(
    recording: &Recording,
    moving: &(Vec<usize>, f64),
    i: usize,
    action: usize,
) -> Option<f64> {
    let (rows, usual) = moving;
    let most_others = ((1.0 - SHARE) * rows.len() as f64) as usize;
    let share = |unit: f64| {
        let is_other = |row: &&usize| {
            let copy = unit * f64::from(recording.observation(**row)[i]);
            (f64::from(recording.action(**row)[action]) - copy).abs() > OFF * unit * usual
        };
        let others = rows.iter().filter(is_other).take(most_others + 1).count();
        (others <= most_others).then(|| 1.0 - others as f64 / rows.len() as f64)
    };
    (rows.len() >= FEWEST).then(|| UNITS.into_iter().find_map(share))?
}
