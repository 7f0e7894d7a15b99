//! What looks wrong with a dataset, though training puts up with it.

use crate::formats::Source;
use crate::recording::{Recording, RowKind};
use crate::{DatasetError, EnvironmentSpec};

/// Nothing that walks through a maze comes further in one step of a tenth of a second.
const LONGEST_STEP: f32 = 1.0;

/// One sentence for each kind of thing.
pub(super) fn findings(
    source: &Source,
    recording: &Recording,
    environment: Option<&EnvironmentSpec>,
) -> Result<Vec<String>, DatasetError> {
    let mut findings = Vec::new();
    if source.lacks_timeouts() {
        findings.push(match environment {
            Some(environment) => format!(
                "no array `timeouts`: an episode is taken to end after the {} steps of {}",
                environment.max_episode_steps, environment.name
            ),
            None => "no array `timeouts`: only a terminal is taken to end an episode".to_owned(),
        });
    }
    let stored = match &recording.next_observations {
        None => source.unused_next_observations(recording)?,
        stored => stored.clone(),
    };
    if let Some(stored) = stored {
        findings.extend(breaks(recording, &stored));
    }
    if recording.goal {
        findings.extend(leaps(recording));
    }
    Ok(findings)
}

/// Rows inside an episode whose stored next observation is not the one that follows.
fn breaks(recording: &Recording, next_observations: &[f32]) -> Option<String> {
    let (row, count) = first(inside(recording).filter(|&row| recording.jumps(next_observations, row)))?;
    Some(format!(
        "array `next_observations`, row {row}: not the observation of the row that follows, though the episode goes on \
         there ({}); is a timeout missing?",
        such_rows(count)
    ))
}

/// Rows inside an episode from which the place, an observation's first two numbers, is too far from the next one.
fn leaps(recording: &Recording) -> Option<String> {
    let leap = |&row: &usize| {
        let (from, to) = (recording.observation(row), recording.observation(row + 1));
        let apart = from.iter().zip(to).take(2).map(|(from, to)| (to - from).powi(2)).sum::<f32>().sqrt();
        apart > LONGEST_STEP
    };
    let (row, count) = first(inside(recording).filter(leap))?;
    let (array, row) = recording.place("observations", row);
    Some(format!(
        "array `{array}`, row {row}: the next place is more than {LONGEST_STEP} m away, though the episode goes on there \
         ({}); are the timeouts out of step with the resets?",
        such_rows(count)
    ))
}

/// Rows to which the next row is said to belong.
fn inside(recording: &Recording) -> impl Iterator<Item = usize> {
    let last = recording.rows().saturating_sub(1);
    (0..last).filter(|&row| recording.kinds[row] != RowKind::LastState && !recording.ends[row])
}

fn first(mut rows: impl Iterator<Item = usize>) -> Option<(usize, usize)> {
    Some((rows.next()?, 1 + rows.count()))
}

fn such_rows(count: usize) -> String {
    if count == 1 { "1 such row".to_owned() } else { format!("{count} such rows") }
}
