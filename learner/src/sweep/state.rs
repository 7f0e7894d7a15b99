//! How far a run is, by its folder alone.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use anyhow::anyhow;
use quad_service::hinted;
use serde::Deserialize;

use super::study::PlannedRun;
use crate::config::settings;
use crate::report::RunReport;
use crate::run::RunDir;

/// The file by which a sweep remembers that a run has failed.
const FAILED: &str = "failed";
/// The last two lines of `metrics.jsonl` are in its last bytes, so many.
const TAIL: u64 = 8192;

/// How far a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    /// It has no folder.
    NotBegun,
    /// So many steps are done; perhaps all of them, while scores are missing.
    Begun(u64),
    /// As far as that, and the learner ended with an error.
    Failed(u64),
    /// All steps are done and all episodes scored.
    Complete,
}

impl State {
    /// That of the run in a folder.
    ///
    /// # Errors
    /// A run with other settings is there, or a file is not what a learner writes.
    pub fn of(run: &PlannedRun, dir: &Path) -> anyhow::Result<Self> {
        let failed = dir.join(FAILED).exists();
        if !RunDir::is_occupied(dir) {
            return Ok(if failed { Self::Failed(0) } else { Self::NotBegun });
        }
        let (folder, config) = RunDir::open(dir)?;
        let (old, new) = (settings::of_experiment(&config.experiment), settings::of_experiment(&run.experiment));
        let mut differences: Vec<_> = settings::differences(&old, &new).map(String::as_str).collect();
        if config.experiment.dataset != run.experiment.dataset {
            differences.push("dataset");
        }
        if !differences.is_empty() {
            let (path, keys) = (dir.display(), differences.join(", "));
            let hint = "give the study's file another name, choose another --runs, or move that folder away";
            return Err(hinted(anyhow!("{path} has a run of other settings than the study's: {keys}"), hint));
        }
        let scored = RunReport::scored(dir)?.is_complete();
        let trained = run.experiment.eval_interval > 0 || folder.snapshots()?.last() == Some(&run.experiment.steps);
        let step = || rows(dir).last().map_or(0, |row| row.step);
        Ok(match (scored && trained, failed) {
            (true, _) => Self::Complete,
            (false, true) => Self::Failed(step()),
            (false, false) => Self::Begun(step()),
        })
    }

    /// Steps that are done, of a run of so many.
    pub fn step(self, steps: u64) -> u64 {
        match self {
            Self::NotBegun => 0,
            Self::Begun(step) | Self::Failed(step) => step,
            Self::Complete => steps,
        }
    }

    /// In words, for a run of so many steps.
    pub fn text(self, steps: u64) -> String {
        match self {
            Self::NotBegun => "not begun".to_owned(),
            Self::Begun(step) if step == steps => "trained, not all scored".to_owned(),
            Self::Begun(step) => format!("{step} of {steps} steps"),
            Self::Failed(step) => format!("failed after {step} of {steps} steps"),
            Self::Complete => "complete".to_owned(),
        }
    }
}

/// Remembers that a run has failed, or forgets it.
pub(super) fn mark_failed(dir: &Path, failed: bool) -> io::Result<()> {
    let path: PathBuf = dir.join(FAILED);
    match failed {
        true => fs::write(path, ""),
        false => fs::remove_file(path).or_else(|error| match error.kind() {
            io::ErrorKind::NotFound => Ok(()),
            _ => Err(error),
        }),
    }
}

/// What a run at work is seen to do.
#[derive(Default)]
pub(super) struct Progress {
    /// Gradient steps done.
    pub step: u64,
    /// In a second.
    pub rate: f64,
    /// The newest whole evaluation: step and mean score.
    pub score: Option<(u64, f64)>,
}

impl Progress {
    /// That of the run in a folder.
    pub fn read(dir: &Path) -> Self {
        let rows = rows(dir);
        let rate = match &rows[..] {
            [.., before, last] if last.seconds > before.seconds => {
                (last.step - before.step) as f64 / (last.seconds - before.seconds)
            }
            _ => 0.0,
        };
        let report = RunReport::scored(dir).ok();
        let newest = report.iter().flat_map(|report| &report.evaluations).rfind(|evaluation| evaluation.complete);
        let score = newest.map(|evaluation| (evaluation.step, evaluation.score.mean));
        Self { step: rows.last().map_or(0, |row| row.step), rate, score }
    }
}

impl fmt::Display for Progress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.1} steps/s", self.rate)?;
        self.score.map_or(Ok(()), |(step, score)| write!(f, ", score {score:.1} @{step}"))
    }
}

/// What is read of a line of `metrics.jsonl`.
#[derive(Deserialize)]
struct Row {
    step: u64,
    seconds: f64,
}

/// The last lines of `metrics.jsonl`; those that are half written or half read are none.
fn rows(dir: &Path) -> Vec<Row> {
    let read = || -> io::Result<Vec<u8>> {
        let mut file = File::open(dir.join("metrics.jsonl"))?;
        let length = file.metadata()?.len();
        file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    let bytes = read().unwrap_or_default();
    bytes.split(|byte| *byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok()).collect()
}
