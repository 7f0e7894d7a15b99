//! D4RL's HDF5 files, of all its versions, and AntMaze's.

use crate::error::Problem;
use crate::formats::hdf5_file::Hdf5File;
use crate::recording::{Recording, RowKind};
use crate::rounding::Rounding;
use crate::tables::environment::EnvironmentSpec;

/// Reads `observations`, `actions`, `rewards`, `terminals` and, if there, `timeouts` by the rules
/// of D4RL's `qlearning_dataset`: the next observation is the following row's, whatever the file
/// stores; timeouts and the last row make no transition. A terminal row's next observation belongs
/// to another episode, but its mask is 0.
///
/// Without timeouts, a row at which an episode reaches the environment's time limit counts as one.
/// Where the file stores `next_observations`, they are kept aside, to see whether the rows follow
/// one another at all.
pub(super) fn read(
    file: &Hdf5File,
    environment: Option<&EnvironmentSpec>,
) -> Result<Recording, Problem> {
    let observations = file.numbers("observations")?;
    let rows = observations.rows();
    let actions = file.actions("actions")?.of_rows(rows)?;
    let terminals = file.flags("terminals", rows)?;
    let timeouts = match (file.has("timeouts"), environment) {
        (true, _) => file.flags("timeouts", rows)?,
        (false, Some(environment)) => derive_timeouts(&terminals, environment.max_episode_steps),
        (false, None) => vec![false; rows],
    };
    // A recording continues after the goal: only its timeouts end an episode.
    let goal =
        environment.is_some_and(|environment| environment.maze.is_some()) || file.has("infos/goal");
    let until_timeout = goal && timeouts.contains(&true);
    let ends = terminals
        .iter()
        .zip(&timeouts)
        .map(|(&terminal, &timeout)| timeout || (terminal && !until_timeout));
    let kind = |(row, &timeout): (usize, &bool)| match timeout || row + 1 == rows {
        true => RowKind::Dropped,
        false => RowKind::Transition,
    };
    let unused_next_observations = match file.has("next_observations") {
        true => Some(file.table("next_observations", rows, observations.width)?),
        false => None,
    };
    let stored: Option<&Vec<f32>> = unused_next_observations.as_ref();
    Ok(Recording {
        rounding: stored
            .map(|stored| Rounding::between(&observations.values, stored))
            .unwrap_or_default(),
        observation_dim: observations.width,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: file.table("rewards", rows, 1)?,
        unused_next_observations,
        kinds: timeouts.iter().enumerate().map(kind).collect(),
        ends: ends.collect(),
        terminals,
        terminal_array: "terminals",
        timeouts,
        goal,
        ..Recording::default()
    })
}

/// The rows at which an episode reaches `limit` steps, as D4RL counts them: the row after a timeout
/// is number 0, but the row after a terminal is number 1, so that such an episode is cut off a step
/// early.
fn derive_timeouts(terminals: &[bool], limit: usize) -> Vec<bool> {
    let mut number = 0;
    let timeout = |&terminal: &bool| {
        let timeout = number + 1 == limit;
        number = match (timeout, terminal) {
            (true, _) => 0,
            (false, true) => 1,
            (false, false) => number + 1,
        };
        timeout
    };
    terminals.iter().map(timeout).collect()
}
