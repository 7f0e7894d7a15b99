//! Observations recorded one row late, after their row's action.
//!
//! A step should be explained by its row's action. In late data it is explained by the next row's.
//! A feedback policy's next action also explains part of a step: on MuJoCo robots up to 0.45 of the
//! variance that the right action does.

use crate::recording::Recording;

const ROWS: usize = 4000;
const FEWEST: usize = 200;
/// Minimum fraction of steps explained by late actions, and minimum ratio to the correct ones.
const EXPLAINED: f64 = 0.5;
const TIMES: f64 = 2.5;
/// Minimum fraction of the actions' variance that observations do not explain.
const FREE: f64 = 0.1;
const ROUNDING: f64 = 1e-5;

type Columns = Vec<Vec<f64>>;

pub(super) fn observations(recording: &Recording) -> Option<String> {
    let rows = recording.some_that_go_on();
    let apart = rows.len().div_ceil(ROWS).max(1);
    let rows = Vec::from_iter(rows.into_iter().step_by(apart));
    let (o, a) = (recording.observation_dim, recording.action_dim);
    if rows.len() < FEWEST.max(10 * (o + a)) {
        return None;
    }
    let columns = |width: usize, number: &dyn Fn(usize, usize) -> f32| -> Columns {
        let column = |i| rows.iter().map(|row| f64::from(number(*row, i))).collect();
        (0..width).map(column).collect()
    };
    let states = columns(o, &|row, i| recording.observation(row)[i]);
    let constant = vec![vec![1.0; rows.len()]];
    let given = basis(constant.iter().chain(&states).cloned());
    let state = |row: usize, i: usize| recording.observation(row)[i];
    let mut steps = columns(o, &|row, i| state(row + 1, i) - state(row, i));
    for (step, state) in steps.iter_mut().zip(&states) {
        *step = without(std::mem::take(step), &given);
        if square(step) <= ROUNDING.powi(2) * square(state) {
            step.clear();
        }
    }
    steps.retain(|step| !step.is_empty());
    let own = columns(a, &|row, i| recording.action(row)[i]);
    let next = columns(a, &|row, i| recording.action(row + 1)[i]);

    let mean = basis(constant.into_iter());
    let sum = |basis: &Columns| -> f64 {
        let rest = |action: &Vec<f64>| square(&without(action.clone(), basis));
        own.iter().map(rest).sum()
    };
    let [own_share, next_share] = [&own, &next].map(|actions| {
        let basis = basis(actions.iter().map(|action| without(action.clone(), &given)));
        let rest = |step: &Vec<f64>| square(&without(step.clone(), &basis)) / square(step);
        let shares = steps.iter().map(|step| 1.0 - rest(step));
        shares.fold(0.0, f64::max)
    });
    let is_late = next_share > EXPLAINED.max(TIMES * own_share) && sum(&given) > FREE * sum(&mean);
    is_late.then(|| {
        format!(
            "array `observations`: one row late? actions explain {:.0} % of the step before their row and {:.0} % of their own, as if \
             each observation were the one after the action; move observations one row down, and drop the first of each episode",
            100.0 * next_share,
            100.0 * own_share
        )
    })
}

fn square(column: &[f64]) -> f64 {
    column.iter().map(|x| x * x).sum()
}

fn basis(columns: impl Iterator<Item = Vec<f64>>) -> Columns {
    let mut basis = Columns::new();
    for column in columns {
        let before = square(&column);
        let mut rest = without(column, &basis);
        let length = square(&rest).sqrt();
        if length > 1e-6 * before.sqrt() {
            rest.iter_mut().for_each(|x| *x /= length);
            basis.push(rest);
        }
    }
    basis
}

/// Residual of a column after projection onto the basis; a second projection removes rounding.
fn without(mut column: Vec<f64>, basis: &Columns) -> Vec<f64> {
    for direction in basis.iter().chain(basis) {
        let along: f64 = column.iter().zip(direction).map(|(x, y)| x * y).sum();
        for (x, y) in column.iter_mut().zip(direction) {
            *x -= along * y;
        }
    }
    column
}
