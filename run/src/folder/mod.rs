//! The folder of a run: its files, resuming, and the checks of `learner verify`.
//!
//! A learner's thread `snapshots` writes snapshots, checkpoints and `metrics.jsonl`, `scores` writes
//! `scores.jsonl`, the main thread everything else. A learner at work holds a lock on
//! `scores.jsonl`. Commands that only read may run at any time.
//!
//! In reading order: `run_dir`, `lines`, `lock`, `log`, `experience`, `checkpoints`, `error`, `resume`,
//! `verify`, `verify_experience`.

mod checkpoints;
pub(crate) mod error;
mod experience;
mod lines;
mod lock;
mod log;
mod resume;
mod run_dir;
#[cfg(test)]
mod tests;
pub mod verify;
mod verify_experience;

pub use checkpoints::Checkpoint;
pub use error::RunDirError;
pub use experience::{ExperienceLog, read_experience};
pub use lines::{RunEndpoints, ScoreLine, read_metrics};
pub use lock::Lock;
pub use log::{Log, new_lines};
pub use resume::{ExistingRun, ResumePoint, SavedScores};
pub use run_dir::{RunDir, walk};
pub use verify_experience::verify_experience;
