//! Flags one row before or after the reset they should mark, and resets that no flag marks.
//!
//! Resets are among the longest steps, with each dimension scaled by its root mean square step.
//! Near a correct flag, the longest of three neighboring steps is the flag's.

use super::rows;
use crate::checks;
use crate::error::RowProblem;
use crate::recording::{Recording, RowKind};

/// Candidates for resets per end of an episode.
const CANDIDATES: usize = 4;
/// Minimum number of steps per reset.
const STEPS_BETWEEN_RESETS: usize = 20;
/// Minimum number of resets near flags, and their inverse minimum fraction.
const FEWEST: usize = 5;
const SMALLEST_SHARE: usize = 4;
/// Inverse of the largest fraction of resets exactly at a flag.
const EXCEPTION: usize = 10;
/// Minimum ratio of a missed reset's squared step to those beside it.
const ALONE: f64 = 4.0;
/// Inverse of the largest fraction of steps as long as a reset, if resets are visible.
const COMMON: usize = 4;
/// Largest displacement of a maze robot in a step of 0.1 s, meters.
const LONGEST_STEP: f32 = 1.0;

/// Rows after which a reset is expected.
fn ends(recording: &Recording) -> Vec<usize> {
    let is_last = |row: usize| recording.kinds[row] == RowKind::LastState;
    // Groups per episode cannot be shifted; a final state ends its episode, not the row before.
    let is_reset = |row: &usize| {
        let is_end = recording.ends[*row] || is_last(*row);
        is_end && recording.parts.is_empty() && !is_last(row + 1)
    };
    let inner = 1..recording.rows().saturating_sub(2);
    inner.filter(is_reset).collect()
}

pub(super) fn out_of_step(recording: &Recording) -> Vec<String> {
    let ends = ends(recording);
    if ends.is_empty() {
        return Vec::new();
    }
    let lengths = Vec::from_iter(lengths(recording).into_iter().map(|[length, _]| length));
    let longest = (CANDIDATES * ends.len()).min(lengths.len() / STEPS_BETWEEN_RESETS);
    let mut sorted = lengths.clone();
    sorted.sort_unstable_by(f64::total_cmp);
    let limit = sorted[lengths.len() - 1 - longest];
    let judged = |name, flags: &[usize]| judge(name, flags, &lengths, limit);
    if recording.terminal_array == "masks" {
        // OGBench's `terminals` mark the end of a trajectory, for whatever reason.
        return Vec::from_iter(judged("terminals", &ends));
    }
    let (timeouts, terminals): (Vec<usize>, _) =
        ends.into_iter().partition(|&row| recording.timeouts[row]);
    let mut warnings = Vec::from_iter(judged(recording.terminal_array, &terminals));
    warnings.extend(judged("timeouts", &timeouts));
    warnings
}

/// Counts the offsets of resets, which are longer than `limit`, from flags.
fn judge(name: &str, flags: &[usize], lengths: &[f64], limit: f64) -> Option<String> {
    let mut resets = [0; 3];
    for &row in flags {
        let longest =
            (0..3).max_by(|&a, &b| lengths[row + a - 1].total_cmp(&lengths[row + b - 1]))?;
        resets[longest] += usize::from(lengths[row + longest - 1] > limit);
    }
    let [before, own, after] = resets;
    let (beside, side, late, up) = match before > after {
        true => (before, "before", "late", "up"),
        false => (after, "after", "early", "down"),
    };
    let is_proof =
        beside >= FEWEST && beside * SMALLEST_SHARE >= flags.len() && own * EXCEPTION <= beside;
    is_proof.then(|| {
        format!(
            "array `{name}`: one row {late}, out of step with the resets: states jump at the row {side} ({beside} of {}), \
             which ends no episode, and not at their own, so that resets are learned as steps; move them one row {up}",
            flags.len()
        )
    })
}

/// Steps inside episodes that are as long as those at their ends, and alone so.
pub(super) fn missed(recording: &Recording) -> Option<String> {
    let leap = |&row: &usize| {
        let (from, to) = (recording.observation(row), recording.observation(row + 1));
        let apart = from.iter().zip(to).take(2).map(|(from, to)| to - from);
        apart.map(|x| x.powi(2)).sum::<f32>().sqrt() > LONGEST_STEP
    };
    let leaps = recording.inside().filter(|row| recording.goal && leap(row));
    let leaps = leaps.map(|row| (row, RowProblem::Leap(LONGEST_STEP)));
    let problem = checks::first(recording, "observations", leaps).or_else(|| {
        let resets = unmarked(recording).into_iter();
        let resets = resets.map(|row| (row, RowProblem::Reset));
        checks::first(recording, "observations", resets)
    })?;
    let question = "are timeouts missing, or out of step with the resets?";
    Some(format!("{problem}; {question}"))
}

/// Rows whose step is as long as those at ends, far longer than those beside it, and rarely so.
fn unmarked(recording: &Recording) -> Vec<usize> {
    let (ends, lengths) = (ends(recording), lengths(recording));
    // A sensor slower than control leaps, too.
    if ends.len() < FEWEST || rows::resting_observations(recording).is_some() {
        return Vec::new();
    }
    let mut resets = Vec::from_iter(ends.iter().map(|&row| lengths[row][0]));
    resets.sort_unstable_by(f64::total_cmp);
    let limit = resets[resets.len() / 4];
    let is_inside = |row: usize| recording.is_step(row) && !recording.ends[row];
    let is_longer = |row: usize, beside: usize| {
        !is_inside(beside) || (0..2).all(|i| lengths[row][i] > ALONE * lengths[beside][i])
    };
    let is_alone = |row: usize| is_longer(row, row - 1) && is_longer(row, row + 1);
    let mut leaps = Vec::from_iter(recording.inside().filter(|&row| lengths[row][0] >= limit));
    let is_visible = leaps.len() * COMMON <= recording.inside().count();
    let last = lengths.len() - 1;
    // A crash comes right before an end.
    leaps.retain(|&row| (1..last).contains(&row) && is_inside(row + 1) && is_alone(row));
    match is_visible && leaps.len() >= FEWEST && leaps.len() * EXCEPTION >= ends.len() {
        true => leaps,
        false => Vec::new(),
    }
}

/// Squared length of each step, with each dimension scaled by its root mean square step: of all
/// dimensions, and of all but the one that moves most, which may be an angle that wraps around.
fn lengths(recording: &Recording) -> Vec<[f64; 2]> {
    let square = |row: usize, i: usize| {
        let from = f64::from(recording.observation(row)[i]);
        let to = f64::from(recording.observation(row + 1)[i]);
        let square = (to - from).powi(2);
        if square.is_finite() { square } else { 0.0 }
    };
    let steps = 0..recording.rows().saturating_sub(1);
    let mean = |i: usize| steps.clone().map(|row| square(row, i)).sum::<f64>() / steps.len() as f64;
    let moving = (0..recording.observation_dim).map(|i| (i, mean(i)));
    let moving = Vec::from_iter(moving.filter(|(_, mean)| *mean > 0.0));
    let length = |row| {
        let scaled = moving.iter().map(|&(i, mean)| square(row, i) / mean);
        let (sum, most) = scaled.fold((0.0, 0.0), |(sum, most), x| (sum + x, f64::max(most, x)));
        [sum, sum - most]
    };
    steps.clone().map(length).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::tests::recording;

    #[test]
    fn a_shift_of_ogbenchs_terminals_is_not_put_down_to_masks() {
        let kind = |row: usize| match row > 0 && row.is_multiple_of(30) {
            true => RowKind::LastState,
            false => RowKind::Transition,
        };
        let mut recording = recording(&Vec::from_iter((0..600).map(kind)));
        for row in 0..600 {
            recording.observations[row] = (1000 * (row / 30) % 7000 + row % 30) as f32;
            recording.ends[row] = row % 30 == 29;
        }
        recording.terminal_array = "masks";
        let warnings = out_of_step(&recording).concat();
        let start = "array `terminals`: one row late";
        assert!(warnings.starts_with(start), "{warnings}");
    }
}
