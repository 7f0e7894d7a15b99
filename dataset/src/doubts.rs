//! What can be trained on, though nothing good may come of it.

use crate::recording::{Recording, RowKind};

/// The largest root mean square of a number of the observations that nothing is said of. Where one of a cart's four was this
/// large, IQL's critic loss after 3,000 steps was twice that with all near 1; at three times this, fourteen times. D4RL's mazes
/// measure 36 m.
const LARGEST: f64 = 100.0;

/// One sentence for each doubt about the numbers of a recording, whose observations are scaled or not.
pub(crate) fn doubts(recording: &Recording, is_scaled: bool) -> Vec<String> {
    let large = large_observations(recording).filter(|_| !is_scaled);
    equal_rewards(recording).into_iter().chain(large).collect()
}

/// Rewards that are all alike.
fn equal_rewards(recording: &Recording) -> Option<String> {
    let is_step = |row: &usize| recording.kinds[*row] != RowKind::LastState;
    let mut rewards = (0..recording.rows()).filter(is_step).map(|row| recording.rewards[row]);
    let first = rewards.next()?;
    let terminals = recording.terminals.contains(&true) && first != 0.0;
    let but = if terminals { " but how soon an episode terminates" } else { "" };
    rewards
        .all(|reward| reward == first)
        .then(|| format!("array `rewards`: all are alike ({first}), so nothing distinguishes good from bad{but}"))
}

/// Numbers of an observation that are far from ±1.
fn large_observations(recording: &Recording) -> Option<String> {
    let size = |i: usize| {
        let rows = recording.transitions().map(|row| f64::from(recording.observation(row as usize)[i]));
        let (count, sum) =
            rows.filter(|x| x.is_finite()).fold((0.0, 0.0), |(count, sum), x| (count + 1.0, sum + x * x));
        (i, f64::sqrt(sum / count))
    };
    let large: Vec<_> = (0..recording.observation_dim).map(size).filter(|(_, size)| *size > LARGEST).collect();
    let largest = large.iter().map(|(_, size)| *size).fold(0.0, f64::max);
    let columns: Vec<String> = large.iter().map(|(i, _)| i.to_string()).collect();
    (!columns.is_empty()).then(|| {
        format!(
            "array `observations`: far from ±1 in column {}, of size {largest:.0}, which spoils training; `learner train --scale \
             states` trains on it",
            columns.join(", ")
        )
    })
}
