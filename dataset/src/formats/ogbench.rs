//! OGBench's npz files, as they are published or as its loader returns them.

use crate::error::Problem;
use crate::formats::npz_file::NpzFile;
use crate::recording::{Recording, RowKind};
use crate::tables::maze::MazeTask;

/// Reads a file of OGBench. `terminals` mark the end of a trajectory; the mask is 0 only where
/// `masks` is. In stored files, a trajectory's last row is its final state and starts no
/// transition. In arrays returned by OGBench's loader, each row has `next_observations`, or
/// `valids` marks rows that start a transition.
pub(super) fn read(file: &mut NpzFile, task: Option<MazeTask>) -> Result<Recording, Problem> {
    let observations = file.numbers("observations")?;
    let (rows, observation_dim) = (observations.rows(), observations.width);
    let actions = file.actions("actions")?.with_rows(rows)?;
    let terminals = file.numbers("terminals")?.into_flags(rows)?;
    let masks = match file.has("masks") {
        true => file.numbers("masks")?.into_flags(rows)?,
        false => vec![true; rows],
    };
    let next_observations = match file.has("next_observations") {
        true => {
            let stored = file.numbers("next_observations")?;
            Some(stored.sized(rows, observation_dim)?)
        }
        false => None,
    };
    let ends_here = |row: usize| terminals[row] || row + 1 == rows;
    let last_states: Vec<bool> = match (&next_observations, file.has("valids")) {
        (Some(_), _) => vec![false; rows],
        (None, true) => {
            let valids = file.numbers("valids")?.into_flags(rows)?;
            valids.into_iter().map(|valid| !valid).collect()
        }
        // A trajectory truncated by the end of the file also ends in a final state.
        (None, false) => (0..rows).map(ends_here).collect(),
    };
    let is_last = |row: usize| match &next_observations {
        Some(_) => terminals[row],
        None => !last_states[row] && terminals.get(row + 1) == Some(&true) && last_states[row + 1],
    };
    let ends: Vec<bool> = (0..rows).map(is_last).collect();
    let lacks_masks = file.has("rewards") && !file.has("masks");
    let doubt = lacks_masks.then(|| {
        "no array `masks`: no step counts as terminal, as `terminals` are the ends of OGBench's trajectories".to_owned()
    });
    let kind = |last: &bool| match last {
        true => RowKind::LastState,
        false => RowKind::Transition,
    };
    let is_terminal = |row: usize| !masks[row] && !last_states[row];
    let recording = Recording {
        observation_dim,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: match task {
            Some(_) => vec![0.0; rows],
            None => file.numbers("rewards")?.sized(rows, 1)?,
        },
        kinds: last_states.iter().map(kind).collect(),
        terminals: (0..rows).map(is_terminal).collect(),
        terminal_array: "masks",
        timeouts: (0..rows).map(|row| ends[row] && masks[row]).collect(),
        ends,
        next_observations,
        doubts: doubt.into_iter().collect(),
        ..Recording::default()
    };
    Ok(recording.with_jumps())
}
