//! D4RL's HDF5 files, including AntMaze.

use crate::error::Problem;
use crate::formats::hdf5_file::Hdf5File;
use crate::recording::{Recording, RowKind};
use crate::tables::environment::EnvironmentSpec;

/// Reads a file as D4RL's `qlearning_dataset` does: the next observation is the following row's,
/// and timeouts and the last row make no transition. A terminal row's next observation belongs to
/// another episode, but its mask is 0.
///
/// Missing `timeouts` follow from `episode_terminals`, which d3rlpy 1 wrote in their place, or from
/// the environment's time limit. Stored `next_observations` serve
/// only to check the order of the rows, and to know goals at which the episode ended.
pub(super) fn read(
    file: &Hdf5File,
    environment: Option<&EnvironmentSpec>,
) -> Result<Recording, Problem> {
    let observations = file.numbers("observations")?;
    let rows = observations.rows();
    let actions = file.actions("actions")?.with_rows(rows)?;
    let terminals = file.flags("terminals", rows)?;
    let mut doubts = Vec::new();
    let timeouts = if file.has("timeouts") {
        file.flags("timeouts", rows)?
    } else if file.has("episode_terminals") {
        let ends = file.flags("episode_terminals", rows)?;
        let ends = ends.into_iter().zip(&terminals);
        ends.map(|(end, terminal)| end && !terminal).collect()
    } else {
        let (timeouts, end) = match environment {
            Some(spec) => {
                let limit = spec.max_episode_steps;
                let end = format!("after the {limit} steps of {}", spec.name);
                (derive_timeouts(&terminals, limit), end)
            }
            None => (vec![false; rows], "at a terminal alone".to_owned()),
        };
        doubts.push(format!("no array `timeouts`: an episode is taken to end {end}"));
        timeouts
    };
    // The recording continues after the goal: only timeouts end an episode.
    let is_maze = environment.is_some_and(|environment| environment.maze.is_some());
    // Goals without terminals, as of mazes with dense rewards, end nothing.
    let goal = is_maze || (file.has("infos/goal") && terminals.contains(&true));
    let until_timeout = goal && timeouts.contains(&true);
    let ends = (0..rows).map(|row| timeouts[row] || (terminals[row] && !until_timeout));
    let kind = |row: usize| match timeouts[row] || row + 1 == rows {
        true => RowKind::Dropped,
        false => RowKind::Transition,
    };
    let mut recording = Recording {
        unused_next_observations: match file.has("next_observations") {
            true => Some(file.table("next_observations", rows, observations.width)?),
            false => None,
        },
        observation_dim: observations.width,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: file.table("rewards", rows, 1)?,
        kinds: (0..rows).map(kind).collect(),
        ends: ends.collect(),
        terminals,
        terminal_array: "terminals",
        timeouts,
        goal,
        doubts,
        ..Recording::default()
    };
    recording = recording.with_jumps();
    for row in 0..rows {
        recording.ends[row] |= recording.terminals[row] && recording.jumps(row);
    }
    Ok(recording)
}

/// Rows at which an episode reaches `limit` steps, counted as in D4RL: from 0 after a timeout but
/// from 1 after a terminal, so that the latter episode is truncated a step early.
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
