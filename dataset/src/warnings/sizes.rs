//! Observations and actions whose scale is too large or too small.

use super::{named, short};
use crate::normalize::Normalize;
use crate::recording::{Recording, RowKind};

/// Largest accepted root mean square of a dimension. At this size of one of a simulated cart's
/// four, IQL's critic loss after 3,000 steps was twice that with all near 1; at three times,
/// fourteen times. D4RL's mazes reach 36 m.
const LARGEST: f64 = 100.0;
/// Smallest accepted standard deviation of a dimension that changes. D4RL's smallest is 0.05.
const SMALLEST: f64 = 1e-3;
const ROUNDING: f64 = 1e-6;

pub(super) fn columns(recording: &Recording, normalize: Normalize) -> Vec<String> {
    let Recording { observation_dim, action_dim, observations, actions, kinds, names, .. } =
        recording;
    let mut warnings = Vec::new();
    if !normalize.observations {
        let columns =
            moments(observations, *observation_dim, |row| kinds[row] == RowKind::Transition);
        let (large, largest) = most(&columns, |[size, _]| (size > LARGEST).then_some(size));
        warnings.extend((!large.is_empty()).then(|| {
            format!(
                "array `observations`: far from ±1 in {}, of size {largest:.0}, which spoils training; `learner train --normalize observations` \
                 trains on it",
                named(&large, &names.observations)
            )
        }));
        warnings.extend(small("observations", &columns, &names.observations));
    }
    if !normalize.actions {
        let columns = moments(actions, *action_dim, |row| kinds[row] != RowKind::LastState);
        warnings.extend(small("actions", &columns, &names.actions));
    }
    warnings
}

fn small(array: &str, columns: &[[f64; 2]], names: &[String]) -> Option<String> {
    let changes = |[size, deviation]: [f64; 2]| deviation < SMALLEST && deviation > ROUNDING * size;
    let (small, largest) = most(columns, |column| changes(column).then_some(column[1]));
    (!small.is_empty()).then(|| {
        format!(
            "array `{array}`: hardly changes in {}, by a standard deviation of {}, which networks do not tell from 0; `learner train \
             --normalize {array}` trains on it",
            named(&small, names),
            short(largest)
        )
    })
}

fn most(columns: &[[f64; 2]], of: impl Fn([f64; 2]) -> Option<f64>) -> (Vec<usize>, f64) {
    let found = columns.iter().enumerate().filter_map(|(i, column)| Some((i, of(*column)?)));
    let (numbers, figures): (Vec<usize>, Vec<f64>) = found.unzip();
    (numbers, figures.into_iter().fold(0.0, f64::max))
}

/// Root mean square and standard deviation of each column's finite numbers.
fn moments(values: &[f32], width: usize, counts: impl Fn(usize) -> bool) -> Vec<[f64; 2]> {
    let mut sums = vec![[0.0; 3]; width];
    for (_, row) in values.chunks_exact(width.max(1)).enumerate().filter(|(row, _)| counts(*row)) {
        for ([count, sum, squares], x) in sums.iter_mut().zip(row).filter(|(_, x)| x.is_finite()) {
            let x = f64::from(*x);
            (*count, *sum, *squares) = (*count + 1.0, *sum + x, *squares + x * x);
        }
    }
    let of = |[count, sum, squares]: [f64; 3]| {
        let square = squares / count;
        [square.sqrt(), (square - (sum / count).powi(2)).max(0.0).sqrt()]
    };
    sums.into_iter().map(of).collect()
}
