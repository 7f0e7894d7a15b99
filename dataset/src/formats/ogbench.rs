//! OGBench's npz files, as they are published or as its loader returns them.

use crate::error::Problem;
use crate::formats::npz_file::NpzFile;
use crate::recording::{Recording, RowKind};
use crate::same_state::SameState;
use crate::tables::maze::MazeTask;

/// Reads a file of OGBench. `terminals` mark the end of a trajectory; the mask is 0 only where
/// `masks` is. In stored files, a trajectory's last row is its final state and starts no
/// transition. In arrays returned by OGBench's loader, each row has `next_observations`, or
/// `valids` marks rows that start a transition.
pub(super) fn read(file: &mut NpzFile, task: Option<MazeTask>) -> Result<Recording, Problem> {
    let observations = file.numbers("observations")?;
    let (rows, observation_dim) = (observations.rows(), observations.width);
    let actions = file.actions("actions")?.of_rows(rows)?;
    let terminals = file.flags("terminals", rows)?;
    let masks = match file.has("masks") {
        true => file.flags("masks", rows)?,
        false => vec![true; rows],
    };
    let stored = file.has("next_observations");
    let stored = stored.then(|| file.table("next_observations", rows, observation_dim));
    let next_observations: Option<Vec<f32>> = stored.transpose()?;
    let last_states: Vec<bool> = match (&next_observations, file.has("valids")) {
        (Some(_), _) => vec![false; rows],
        (None, true) => file.flags("valids", rows)?.into_iter().map(|valid| !valid).collect(),
        // A trajectory truncated by the end of the file also ends in a final state.
        (None, false) => (0..rows).map(|row| terminals[row] || row + 1 == rows).collect(),
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
    let kind = |&last: &bool| if last { RowKind::LastState } else { RowKind::Transition };
    Ok(Recording {
        same_state: SameState::between(
            &observations.values,
            next_observations.as_deref(),
            observation_dim,
        ),
        observation_dim,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: match task {
            Some(_) => vec![0.0; rows],
            None => file.table("rewards", rows, 1)?,
        },
        kinds: last_states.iter().map(kind).collect(),
        terminals: masks.iter().zip(&last_states).map(|(&mask, &last)| !mask && !last).collect(),
        terminal_array: "masks",
        timeouts: (0..rows).map(|row| ends[row] && masks[row]).collect(),
        ends,
        next_observations,
        doubts: doubt.into_iter().collect(),
        ..Recording::default()
    })
}
