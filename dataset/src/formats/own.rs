//! Custom layout: HDF5 with one row per transition.

use crate::error::Problem;
use crate::formats::hdf5_file::Hdf5File;
use crate::recording::{Recording, RowKind};
use crate::rounding::Rounding;

/// Value of the root attribute `layout` that distinguishes this layout from D4RL's.
pub(crate) const LAYOUT: &str = "transitions";

pub(crate) const OBSERVATION_NAMES: &str = "observation_names";
pub(crate) const ACTION_NAMES: &str = "action_names";

/// Reads the custom layout. Terminals and timeouts end an episode; without `timeouts`, so does a
/// next observation that differs from the following row's observation.
pub(super) fn read(file: &Hdf5File) -> Result<Recording, Problem> {
    let observations = file.numbers("observations")?;
    let (rows, observation_dim) = (observations.rows(), observations.width);
    let actions = file.actions("actions")?.of_rows(rows)?;
    let next_observations = file.table("next_observations", rows, observation_dim)?;
    let mut recording = Recording {
        rounding: Rounding::between(&observations.values, &next_observations),
        observation_dim,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: file.table("rewards", rows, 1)?,
        kinds: vec![RowKind::Transition; rows],
        terminals: file.flags("terminals", rows)?,
        terminal_array: "terminals",
        timeouts: match file.has("timeouts") {
            true => file.flags("timeouts", rows)?,
            false => vec![false; rows],
        },
        ..Recording::default()
    };
    recording.ends = match file.has("timeouts") {
        true => (0..rows).map(|row| recording.terminals[row] || recording.timeouts[row]).collect(),
        false => (0..rows)
            .map(|row| recording.terminals[row] || recording.jumps(&next_observations, row))
            .collect(),
    };
    recording.names.observations = file.names(OBSERVATION_NAMES, observation_dim)?;
    recording.names.actions = file.names(ACTION_NAMES, recording.action_dim)?;
    recording.next_observations = Some(next_observations);
    Ok(recording)
}
