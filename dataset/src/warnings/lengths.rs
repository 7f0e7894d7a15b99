//! Episodes too short for what is to be learned from them, or as long as a time limit.

use super::percent;
use crate::recording::Recording;

/// Inverse of the largest plausible fraction of rows at which an episode of no flag ends.
const SHORTEST: usize = 4;
/// Minimum number of terminals at the longest length, and their inverse minimum fraction.
const FEWEST: usize = 10;
const SMALLEST_SHARE: usize = 3;
/// Minimum longest length: of few possible lengths, each is frequent.
const LONG: usize = 10;

/// Rows at which no flag ends an episode, but a next observation that leads elsewhere.
pub(super) fn single_steps(recording: &Recording) -> Option<String> {
    let is_flagged = |row: usize| recording.terminals[row] || recording.timeouts[row];
    let rows = recording.rows();
    let ends = (0..rows).filter(|&row| recording.ends[row] && !is_flagged(row));
    let jumps = ends.filter(|&row| recording.jumps(row)).count();
    (jumps * SHORTEST > rows).then(|| {
        format!(
            "array `next_observations`: is not the state of the next row in {} of the rows, and without `timeouts` an episode ends at \
             each; noise between two readings of a state? write `timeouts`. Of rows out of order no chunks can be learned",
            percent(jumps, rows)
        )
    })
}

/// Terminals that stand exactly where the longest episodes end.
pub(super) fn time_limit(recording: &Recording) -> Option<String> {
    let (mut lengths, mut length, mut longest) = (Vec::new(), 0, 0);
    for row in recording.steps() {
        length += 1;
        match (recording.ends[row], recording.terminals[row]) {
            // The recording goes on after a goal.
            (false, true) => return None,
            (false, false) => continue,
            (true, terminal) => lengths.extend(terminal.then_some(length)),
        }
        longest = longest.max(std::mem::take(&mut length));
    }
    let count = lengths.iter().filter(|length| **length == longest).count();
    let is_limit = longest >= LONG && count >= FEWEST && count * SMALLEST_SHARE >= lengths.len();
    is_limit.then(|| {
        format!(
            "array `{}`: {count} of {} stand exactly at the longest length of an episode, {longest} steps; a time limit? an episode \
             that it cuts off is not over, so mark those as truncated (`timeouts`), or critics learn that nothing follows",
            recording.terminal_array,
            lengths.len()
        )
    })
}

/// A chunk of more steps than any episode has.
pub(super) fn chunks(recording: &Recording, chunk: usize) -> Option<String> {
    let episodes = recording.episodes();
    let longest = episodes.iter().map(|episode| episode.length).max()?;
    (chunk > longest).then(|| {
        format!(
            "no episode has the {chunk} steps of a chunk, the longest {longest}: the actions after these are not in the data; \
             `learner train --agent chunk={longest}` learns shorter ones"
        )
    })
}
