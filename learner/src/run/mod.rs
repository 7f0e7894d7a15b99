//! The folder of a run: its files, how a run continues in it, and how `learner verify` checks it.
//!
//! It runs on its callers' threads: `snapshots` writes snapshots, checkpoints and `metrics.jsonl`, `scores` writes
//! `scores.jsonl`, the main thread everything else. Commands that only read may run at any time. A learner at work holds a
//! lock on `scores.jsonl`.
//!
//! In reading order: `folder`, `lines` (of its files), `log` (files that only grow), `checkpoints`, `durable` (files that are
//! written whole or not at all), `error`, `resume` (continues a run), `verify` (checks a run).

mod checkpoints;
mod durable;
mod error;
mod folder;
mod lines;
mod log;
mod resume;
#[cfg(test)]
#[path = "../../tests/unit/run.rs"]
pub(crate) mod tests;
pub(crate) mod verify;

pub(crate) use checkpoints::Checkpoint;
pub use error::RunDirError;
pub(crate) use folder::RunDir;
pub(crate) use lines::{RunEndpoints, ScoreLine};
pub(crate) use log::{Log, new_lines};
pub(crate) use resume::{Begun, Past, open};
