//! Flags with another meaning than the end of a task: masks, discounts, lasting successes.

use super::percent;
use crate::recording::Recording;

const FEWEST: usize = 10;
/// Largest plausible fraction of terminals: episodes of two steps.
const MOST_TERMINALS: f64 = 0.5;
/// Largest plausible fraction of rows after the goal.
pub(super) const MOST_AFTER_GOAL: f64 = 0.8;
/// Mean squared step, relative to that between random rows, above which states are reset.
const RESET: f64 = 0.5;

pub(super) fn meaning(recording: &Recording) -> Option<String> {
    let steps = recording.steps().count();
    let array = recording.terminal_array;
    if recording.goal {
        let after = recording.past_goal().iter().filter(|past| **past).count();
        return (after as f64 > MOST_AFTER_GOAL * steps as f64).then(|| {
            format!(
                "array `{array}`: {} of the rows come after the goal of their episode, so few lead to it; end each episode at its \
                 first terminal",
                percent(after, steps)
            )
        });
    }
    stays_set(recording, steps)
}

/// Terminals that are set although states continue.
fn stays_set(recording: &Recording, steps: usize) -> Option<String> {
    let array = recording.terminal_array;
    let inner = |row: &usize| {
        recording.is_step(*row) && recording.is_step(row + 1) && !recording.timeouts[*row]
    };
    let flags = &recording.terminals;
    let inner = (0..recording.rows()).filter(inner);
    let (set, unset): (Vec<usize>, _) = inner.partition(|row| flags[*row]);
    let terminals = flags.iter().filter(|terminal| **terminal).count();
    let again = set.iter().filter(|row| flags[**row + 1]).count();
    let is_most = terminals as f64 > MOST_TERMINALS * steps as f64;
    if set.len() < FEWEST
        || !(is_most || 2 * again > terminals)
        || step_length(recording, &set) >= RESET
    {
        return None;
    }
    let is_mask = is_most && (unset.is_empty() || step_length(recording, &unset) >= RESET);
    let cause = match is_mask {
        true => "a mask or a discount (1 − done) in place of the flag? write 1 − it",
        false => "a success that stays set after the goal? end each episode at the first such row",
    };
    Some(format!(
        "array `{array}`: says in {} of the rows that the task is over, but states go on after them; {cause}, or critics \
         learn of nothing that follows",
        percent(terminals, steps)
    ))
}

/// Mean squared step from these rows to the next, relative to that between random rows: median over
/// the dimensions that change.
fn step_length(recording: &Recording, rows: &[usize]) -> f64 {
    let width = recording.observation_dim;
    let square = |x: f64| if x.is_finite() { x * x } else { 0.0 };
    let length = |i: usize| {
        let value = |row: usize| f64::from(recording.observations[row * width + i]);
        let mean = rows.iter().map(|row| value(*row)).sum::<f64>() / rows.len() as f64;
        let variance: f64 = rows.iter().map(|row| square(value(*row) - mean)).sum();
        let step = |row: &usize| square(value(row + 1) - value(*row));
        let steps: f64 = rows.iter().map(step).sum();
        (variance > 0.0).then(|| steps / (2.0 * variance))
    };
    let mut lengths: Vec<f64> = (0..width).filter_map(length).collect();
    lengths.sort_by(f64::total_cmp);
    *lengths.get(lengths.len() / 2).unwrap_or(&f64::INFINITY)
}
