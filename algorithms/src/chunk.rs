//! Chunks: an algorithm learns the actions of several steps in a row as one action (Li, Zhou and
//! Levine 2025, "Reinforcement Learning with Action Chunking"), in view of the last observations.
//!
//! Batches have windows of steps in place of transitions, and nothing else of an algorithm changes:
//! its networks know a chunk as one long action and a history as one long observation, its targets
//! discount what follows a window by the steps in it, and what it predicts for actions beyond the end
//! of an episode is not learned ([`Minibatch`](super::Minibatch)).

use quad_dataset::Window;
use quad_policy::Chunk;
use serde::Deserialize;
use toml::{Table, Value};

use super::error::{AgentError, check};
use super::hyperparameters::Count;

/// The keys that are read here, and not by the algorithm.
#[derive(Deserialize)]
struct Keys {
    /// Steps h of a chunk; 1 if absent.
    chunk: Option<Count>,
    /// Steps that are executed of a chunk; all if absent.
    replan: Option<Count>,
    /// Observations that are seen at a time; 1 if absent.
    history: Option<Count>,
}

/// Takes these keys from an `[agent]` table: the chunk, and the windows of steps to learn it from.
pub(super) fn take(table: &mut Table) -> Result<(Chunk, Window), AgentError> {
    let Keys { chunk, replan, history } = Keys::deserialize(table.clone())?;
    let length = chunk.map_or(1, |length| *length);
    let replan = replan.map_or(length, |replan| *replan);
    check("replan", replan, replan <= length, "at most agent.chunk (--agent replan=K changes it)")?;
    let history = history.map_or(1, |history| *history);
    for key in ["chunk", "replan", "history"] {
        table.remove(key);
    }
    let number = |value: &Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
    let gamma = table.get("gamma").and_then(number).unwrap_or(1.0) as f32;
    Ok((Chunk { history, length, replan }, Window { history, length, gamma }))
}
