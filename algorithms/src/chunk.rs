//! Chunks: an algorithm learns the actions of several steps in a row as one action (Li, Zhou and
//! Levine 2025, "Reinforcement Learning with Action Chunking").
//!
//! Batches have windows of steps in place of transitions, and nothing else of an algorithm changes:
//! its networks know a chunk as one long action, its targets discount what follows a window by the
//! steps in it, and what it predicts for actions beyond the end of an episode is not learned
//! ([`Minibatch`](super::Minibatch)).

use std::sync::Arc;

use quad_dataset::Window;
use quad_policy::Chunk;
use serde::Deserialize;
use toml::{Table, Value};

use super::context::Context;
use super::definition::{self, Definition, Start};
use super::error::{AgentError, check};
use super::hyperparameters::Count;

/// The keys that are read here, and not by the algorithm.
#[derive(Deserialize)]
struct Keys {
    /// Steps h of a chunk; 1 if absent.
    chunk: Option<Count>,
    /// Steps that are executed of a chunk; all if absent.
    replan: Option<Count>,
}

/// Reads an `[agent]` table: its chunk, and all else as the algorithm does, which will learn chunks.
pub(super) fn read(definition: &Definition, table: &Table) -> Result<(Chunk, Start), AgentError> {
    let Keys { chunk, replan } = definition::read(table)?;
    let length = chunk.map_or(1, |length| *length);
    let replan = replan.map_or(length, |replan| *replan);
    if length > 1 && !definition.chunks {
        return Err(AgentError::NoChunks(definition.name));
    }
    check("replan", replan, replan <= length, "at most agent.chunk")?;
    let mut own = table.clone();
    own.remove("chunk");
    own.remove("replan");
    let start = (definition.read)(&own)?;
    let gamma = own.get("gamma").and_then(Value::as_float).unwrap_or(1.0) as f32;
    let window = Window { length, gamma };
    let start = move |context: Context| start(Context { window, ..context });
    Ok((Chunk { length, replan }, Arc::new(start)))
}
