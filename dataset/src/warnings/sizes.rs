//! Observations and actions whose scale is too large or too small.

use super::short;
use crate::error::such_rows;
use crate::normalize::Normalize;
use crate::recording::{Recording, RowKind, named};
use crate::statistics::Summary;

/// Largest accepted root mean square of a dimension. At this size of one of a simulated cart's
/// four, IQL's critic loss after 3,000 steps was twice that with all near 1; at three times,
/// fourteen times. D4RL's mazes reach 36 m.
const LARGEST: f64 = 100.0;
/// Smallest accepted standard deviation of a dimension that changes. D4RL's smallest is 0.05.
const SMALLEST: f64 = 1e-3;
/// Largest fraction of the rows that is taken for errors where it alone makes a dimension large.
const ERRORS: f64 = 0.01;
/// Distance of an outlier from the middle, relative to the range of nearly all rows. A normal
/// distribution's largest of a million is at 1.
const FAR: f32 = 10.0;
const ROUNDING: f64 = 1e-6;

pub(super) fn columns(recording: &Recording, normalize: Normalize) -> Vec<String> {
    let (o, a) = (recording.observation_dim, recording.action_dim);
    let names = &recording.names;
    let mut warnings = Vec::new();
    let is_transition = |row: usize| recording.kinds[row] == RowKind::Transition;
    let columns = Summary::columns(&recording.observations, o, is_transition);
    let is_large = |column: &Summary| (column.rms > LARGEST).then_some(column.rms);
    let large = most(&columns, is_large);
    let errors = match &large {
        Some((large, _)) => errors(recording, large),
        None => None,
    };
    let is_scaled = normalize.observations || errors.is_some();
    warnings.extend(errors);
    warnings.extend(large.filter(|_| !is_scaled).map(|(large, largest)| {
        format!(
            "array `observations`: far from ±1 in {}, of size {largest:.0}, which spoils training; `learner train --normalize observations` \
             trains on it",
            named(&large, &names.observations)
        )
    }));
    if !normalize.observations {
        warnings.extend(small("observations", &columns, &names.observations));
    }
    let columns = Summary::columns(&recording.actions, a, |row| recording.is_step(row));
    if !normalize.actions {
        warnings.extend(small("actions", &columns, &names.actions));
    }
    // Outside of [-1, 1] they must be normalized.
    let is_outside = |column: &Summary| column.min < -1.0 || column.max > 1.0;
    if normalize.actions || columns.iter().any(is_outside) {
        warnings.extend((0..a).find_map(|column| outliers(recording, column)));
    }
    warnings
}

/// A few actions that alone set a column's range, which normalization maps to [-1, 1].
fn outliers(recording: &Recording, column: usize) -> Option<String> {
    let value = |row: usize| (row, recording.action(row)[column]);
    let values = Vec::from_iter(recording.steps().map(value));
    let mut sorted = Vec::from_iter(values.iter().map(|(_, value)| *value));
    sorted.sort_unstable_by(f32::total_cmp);
    let few = (ERRORS / 2.0 * sorted.len() as f64).ceil() as usize;
    let last = sorted.len().checked_sub(few + 1)?;
    let (low, high) = (*sorted.get(few)?, sorted[last]);
    let is_far = |value: f32| high > low && (value - (low + high) / 2.0).abs() > FAR * (high - low);
    let far = Vec::from_iter(values.iter().filter(|(_, value)| is_far(*value)));
    let (row, value) = **far.first()?;
    let (array, row) = recording.place("actions", row);
    Some(format!(
        "array `{array}`, row {row}: {value} in {}, far from nearly all other rows{}; normalized by this range, all others become \
         alike; leave out or repair these rows",
        named(&[column], &recording.names.actions),
        such_rows(far.len())
    ))
}

/// A few rows that alone make these columns large.
fn errors(recording: &Recording, large: &[usize]) -> Option<String> {
    let error = |row: usize| {
        let number = |&column: &usize| (row, column, recording.observation(row)[column]);
        let mut numbers = large.iter().map(number);
        numbers.find(|(_, _, value)| f64::from(value.abs()) > LARGEST)
    };
    let errors = Vec::from_iter(recording.transitions().filter_map(error));
    let is_few = errors.len() as f64 <= ERRORS * recording.transitions().count() as f64;
    let (row, column, value) = *errors.first().filter(|_| is_few)?;
    let (array, row) = recording.place("observations", row);
    Some(format!(
        "array `{array}`, row {row}: {value} in {}, far from nearly all other rows{}; a sensor's error, or a number that stands for \
         none? leave out or repair these rows, or scales and networks follow them",
        named(&[column], &recording.names.observations),
        such_rows(errors.len())
    ))
}

fn small(array: &str, columns: &[Summary], names: &[String]) -> Option<String> {
    let is_small = |Summary { rms, deviation, .. }: &Summary| {
        (*deviation < SMALLEST && *deviation > ROUNDING * rms).then_some(*deviation)
    };
    let (small, largest) = most(columns, is_small)?;
    Some(format!(
        "array `{array}`: hardly changes in {}, by a standard deviation of {}, which networks do not tell from 0; `learner train \
         --normalize {array}` trains on it",
        named(&small, names),
        short(largest)
    ))
}

/// Columns with a value, and the largest value.
fn most(columns: &[Summary], value: impl Fn(&Summary) -> Option<f64>) -> Option<(Vec<usize>, f64)> {
    let value = |(i, column)| Some((i, value(column)?));
    let values = columns.iter().enumerate().filter_map(value);
    let (columns, values): (Vec<usize>, Vec<f64>) = values.unzip();
    Some((columns, values.into_iter().reduce(f64::max)?))
}
