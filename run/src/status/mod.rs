//! Progress of runs, by their folders alone.

pub mod list;

use std::fmt;
use std::io;
use std::path::Path;

use serde::Deserialize;

use crate::files;
use crate::folder::{RunDir, RunDirError};
use crate::results::RunReport;

/// Bytes at the end of `metrics.jsonl` that contain at least two lines.
const TAIL: u64 = 8192;

/// Progress of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum State {
    /// The run has no folder.
    NotBegun,
    /// Gradient steps done. Scores may be missing even if these are all.
    Begun(u64),
    /// Gradient steps done before the learner failed.
    Failed(u64),
    /// All steps are done and all episodes scored, and no learner has failed since.
    Complete,
    /// A file in the folder is damaged.
    Unreadable,
}

impl State {
    /// State of the run of a report.
    pub fn from_report(report: &RunReport) -> Result<Self, RunDirError> {
        let (dir, experiment) = (RunDir::at(&report.dir), &report.config.experiment);
        let last = experiment.total_steps();
        // All checkpoints of a complete run may be deleted.
        let trained = dir.checkpoint_step()?.is_none_or(|step| step == last)
            && (experiment.eval_interval > 0 || dir.snapshots()?.last() == Some(&last));
        let step = || rows(dir.path()).last().map_or(0, |row| row.step);
        Ok(match (dir.failure(), report.is_complete() && trained) {
            (Some(_), _) => Self::Failed(step()),
            (None, true) => Self::Complete,
            (None, false) => Self::Begun(step()),
        })
    }

    /// Gradient steps done of a run with this many.
    pub fn step(self, steps: u64) -> u64 {
        match self {
            Self::NotBegun | Self::Unreadable => 0,
            Self::Begun(step) | Self::Failed(step) => step,
            Self::Complete => steps,
        }
    }

    /// The state in words, for a run with this many steps.
    pub fn text(self, steps: u64) -> String {
        match self {
            Self::NotBegun => "not begun".to_owned(),
            Self::Begun(step) if step == steps => "trained, not all scored".to_owned(),
            Self::Begun(step) => format!("{step} of {steps} steps"),
            Self::Failed(step) => format!("failed after {step} of {steps} steps"),
            Self::Complete => "complete".to_owned(),
            Self::Unreadable => "cannot be read".to_owned(),
        }
    }
}

/// Progress of a run at work.
#[derive(Clone, Copy, Default)]
pub struct Pace {
    /// Gradient steps done.
    pub step: u64,
    /// Gradient steps a second.
    pub rate: f64,
    /// Step and mean score of the newest complete evaluation.
    pub score: Option<(u64, f64)>,
}

impl Pace {
    /// Reads the run in a folder.
    pub fn read(dir: &Path) -> Self {
        let rows = rows(dir);
        let rate = match &rows[..] {
            [.., before, last] if last.seconds > before.seconds => {
                (last.step - before.step) as f64 / (last.seconds - before.seconds)
            }
            _ => 0.0,
        };
        let report = RunReport::scored(dir).ok();
        let newest = report.as_ref().and_then(RunReport::newest);
        let score = newest.map(|newest| (newest.step, newest.score.mean));
        let step = rows.last().map_or(0, |row| row.step);
        Self { step, rate, score }
    }
}

impl fmt::Display for Pace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.1} steps/s", self.rate)?;
        self.score.map_or(Ok(()), |(step, score)| write!(f, ", score {score:.1} @{step}"))
    }
}

/// Progress in a line of `metrics.jsonl`.
#[derive(Deserialize)]
struct Progress {
    step: u64,
    seconds: f64,
}

/// The last complete lines of `metrics.jsonl`.
fn rows(dir: &Path) -> Vec<Progress> {
    let read = || -> io::Result<Vec<u8>> {
        let mut file = files::open(&dir.join("metrics.jsonl"))?;
        let length = file.metadata()?.len();
        files::rest(&mut file, length.saturating_sub(TAIL))
    };
    let bytes = read().unwrap_or_default();
    let lines = bytes.split(|byte| *byte == b'\n');
    lines.filter_map(|line| serde_json::from_slice(line).ok()).collect()
}

#[cfg(test)]
mod tests;
