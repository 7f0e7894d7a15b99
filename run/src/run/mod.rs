//! The folder of a run: its files, how a run continues in it, and how `learner verify` checks it.
//!
//! It runs on its callers' threads: `snapshots` writes snapshots, checkpoints and `metrics.jsonl`,
//! `scores` writes `scores.jsonl`, the main thread everything else. Commands that only read may run
//! at any time. A learner at work holds a lock on `scores.jsonl`.
//!
//! In reading order: `folder`, `find` (looks for such folders), `lines` (of its files), `lock`
//! (keeps a second learner out), `log` (files that only grow), `checkpoints`, `error`, `resume`
//! (continues a run), `verify` (checks a run).

mod checkpoints;
mod error;
mod find;
mod folder;
mod lines;
mod lock;
mod log;
mod resume;
#[cfg(test)]
mod tests;
pub mod verify;

pub use checkpoints::Checkpoint;
pub use error::RunDirError;
pub use find::walk;
pub use folder::RunDir;
pub use lines::{RunEndpoints, ScoreLine, read_metrics};
pub use lock::Lock;
pub use log::{Log, new_lines};
pub use resume::{Begun, Earlier, Past, open};
