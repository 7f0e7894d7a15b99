//! Rows of zeros at the end of the file: arrays made larger than what was recorded into them.

use super::percent;
use crate::recording::Recording;

const FEWEST: usize = 20;

pub(super) fn rows(recording: &Recording) -> Option<String> {
    let all = recording.rows();
    // A recording that rests at 0 ends with a flag.
    let is_zero = |row: &usize| {
        let numbers = recording.observation(*row).iter().chain(recording.action(*row));
        let is_flagged = recording.terminals[*row] || recording.timeouts[*row];
        !is_flagged && recording.rewards[*row] == 0.0 && numbers.copied().all(|x| x == 0.0)
    };
    let zeros = (0..all).rev().take_while(is_zero).count();
    (zeros >= FEWEST && zeros < all).then(|| {
        format!(
            "array `observations`: 0 in the last {zeros} rows ({}), as are actions and rewards: rows that were never written? cut \
             all arrays after the last recorded step",
            percent(zeros, all)
        )
    })
}
