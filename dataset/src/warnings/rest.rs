//! Observations that do not change although actions do.

use super::percent;
use crate::recording::Recording;

const FEWEST: usize = 20;
/// Largest plausible fraction of steps at rest: action chunks of two steps give 0.5.
const MOST_AT_REST: f64 = 0.4;

pub(super) fn observations(recording: &Recording) -> Option<String> {
    let acts = |row: &usize| {
        let is_inner = recording.is_step(*row) && recording.is_step(row + 1);
        is_inner
            && !recording.terminals[*row]
            && recording.action(*row) != recording.action(row + 1)
    };
    let acting: Vec<usize> = (0..recording.rows()).filter(acts).collect();
    let at_rest = |next: &dyn Fn(usize) -> bool| {
        let count = acting.iter().filter(|row| next(**row)).count();
        (acting.len() >= FEWEST && count as f64 > MOST_AT_REST * acting.len() as f64)
            .then(|| percent(count, acting.len()))
    };
    if let Some(share) =
        at_rest(&|row| recording.observation(row + 1) == recording.observation(row))
    {
        return Some(format!(
            "array `observations`: does not change in {share} of the steps between which the action does; that of a chunk's start, or \
             of a sensor slower than control? record one at each step, or keep only the rows where it is new"
        ));
    }
    recording.next_observations.as_ref()?;
    let share = at_rest(&|row| recording.next_observation(row) == recording.observation(row))?;
    Some(format!(
        "array `next_observations`: is the observation of its own row in {share} of the steps; store the one after the step"
    ))
}
