//! D4RL's HDF5 files, of all its versions, and AntMaze's.

use crate::hdf5_file::Hdf5File;
use crate::recording::{Recording, RowKind};
use crate::{DatasetError, EnvironmentSpec};

/// Reads `observations`, `actions`, `rewards`, `terminals` and, if there, `timeouts` by the rules of D4RL's
/// `qlearning_dataset`: the next observation is the following row's, whatever the file stores; timeouts and the last row
/// make no transition. A terminal row's next observation belongs to another episode, but its mask is 0.
///
/// Without timeouts, a row at which an episode reaches the environment's time limit counts as one.
pub(super) fn read(file: &Hdf5File, environment: Option<&EnvironmentSpec>) -> Result<Recording, DatasetError> {
    let observations = file.numbers("observations")?;
    let rows = observations.rows();
    let actions = file.numbers("actions")?.of_rows(rows).map_err(|problem| file.error(problem))?;
    let terminals = file.flags("terminals", rows)?;
    let timeouts = match (file.has("timeouts"), environment) {
        (true, _) => file.flags("timeouts", rows)?,
        (false, Some(environment)) => derive_timeouts(&terminals, environment.max_episode_steps),
        (false, None) => vec![false; rows],
    };
    // A recording goes on after the goal: only its timeouts end an episode.
    let goal = environment.is_some_and(|environment| environment.goal.is_some()) || file.has("infos/goal");
    let until_timeout = goal && timeouts.contains(&true);
    let ends = terminals.iter().zip(&timeouts).map(|(&terminal, &timeout)| timeout || (terminal && !until_timeout));
    let kind = |(row, &timeout): (usize, &bool)| match timeout || row + 1 == rows {
        true => RowKind::Dropped,
        false => RowKind::Transition,
    };
    Ok(Recording {
        observation_dim: observations.width,
        action_dim: actions.width,
        observations: observations.values,
        actions: actions.values,
        rewards: file.table("rewards", rows, 1)?,
        next_observations: None,
        kinds: timeouts.iter().enumerate().map(kind).collect(),
        ends: ends.collect(),
        terminals,
        timeouts,
        goal,
        parts: Vec::new(),
    })
}

/// The rows at which an episode reaches `limit` steps.
fn derive_timeouts(terminals: &[bool], limit: usize) -> Vec<bool> {
    let mut steps = 0;
    let timeout = |&terminal: &bool| {
        steps += 1;
        let timeout = steps == limit;
        if terminal || timeout {
            steps = 0;
        }
        timeout
    };
    terminals.iter().map(timeout).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_limit_makes_timeouts_and_restarts_with_each_episode() {
        let (f, t) = (false, true);
        // Episodes of 3 (limit), 1 (terminal), 3 (limit and terminal), 2 (open) steps.
        let terminals = [f, f, f, t, f, f, t, f, f];
        assert_eq!(derive_timeouts(&terminals, 3), [f, f, t, f, f, f, t, f, f]);
    }
}
