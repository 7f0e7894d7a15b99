//! The folder of a run: everything that is kept of it, how a run goes on in it, and how it is checked.
//!
//! The room runs on the threads that call it: `snapshots` writes snapshots, checkpoints and `metrics.jsonl`, `scores` writes
//! `scores.jsonl`, the main thread everything else, and commands that only read may do so at any time. A learner at work
//! holds a lock on `scores.jsonl`.
//!
//! In reading order: `folder`, `lines` (what its files say), `log` (files that only grow), `checkpoints`, `durable` (files
//! that are whole whatever happens), `error`, `resume` (a run goes on), `verify` (a run is checked by its folder alone).

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
