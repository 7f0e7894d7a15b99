//! The folder of a run.
//!
//! ```text
//! config.toml                        the resolved configuration
//! endpoints.json                     the learner's addresses; written as soon as it listens
//! metrics.jsonl                      training metrics, a line every hundred gradient steps
//! scores.jsonl                       a line per scored episode, written before the evaluator gets its acknowledgment
//! experience.log                     the online episodes, each written before the evaluator gets its acknowledgment
//! snapshots/step_000003000.safetensors   target actor and target critics; written before the evaluation of it begins
//! checkpoints/step_000003000_….safetensors   the newest three training states, to resume from
//! report.json, learning_curve.svg    written at the end
//! judgments.json                     results of `learner judge`
//! failed                             the error with which a learner of a sweep has ended
//! ```

use std::collections::BTreeSet;
use std::fs::{self, DirEntry};
use std::io::{self, ErrorKind};
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::error::{CREATE, RunDirError, SAVE, content, io_error};
use super::lines::{RunEndpoints, ScoreLine};
use super::lock::Lock;
use super::log::{Log, whole_lines};
use crate::config::RunConfig;
use crate::files;

const CONFIG: &str = "config.toml";
const ENDPOINTS: &str = "endpoints.json";
const SCORES: &str = "scores.jsonl";
pub(super) const EXPERIENCE: &str = "experience.log";
const FAILED: &str = "failed";
const SNAPSHOTS: &str = "snapshots";
pub(super) const CHECKPOINTS: &str = "checkpoints";
/// Files and folders that a run needs to continue and to be verified.
const OWN: [&str; 6] = [CONFIG, SCORES, EXPERIENCE, "metrics.jsonl", SNAPSHOTS, CHECKPOINTS];

/// The folder of one run.
#[derive(Clone, Debug)]
pub struct RunDir {
    path: PathBuf,
}

impl RunDir {
    /// True if there is a run in the folder.
    pub fn is_occupied(path: &Path) -> bool {
        path.join(CONFIG).exists()
    }

    /// Refuses to let a command write its result over a file that a learner needs.
    pub fn refuse_own_file(out: &Path) -> Result<(), RunDirError> {
        let Ok(file) = out.canonicalize() else { return Ok(()) };
        let mut runs = file.ancestors().skip(1).take(2).filter(|folder| Self::is_occupied(folder));
        let is_own = runs.any(|run| OWN.iter().any(|name| file.starts_with(run.join(name))));
        if is_own { Err(RunDirError::Own(out.to_owned())) } else { Ok(()) }
    }

    /// Makes or replaces a file that the user has named, unless a learner needs it.
    pub fn write_named(out: &Path, file: &[u8]) -> Result<(), RunDirError> {
        Self::refuse_own_file(out)?;
        files::replace(out, file).map_err(io_error(SAVE, out))
    }

    /// Makes the folder, locks it and saves the configuration. Also returns `scores.jsonl`, which
    /// holds the lock.
    pub fn create(path: &Path, config: &RunConfig) -> Result<(Self, Log), RunDirError> {
        let run = Self::at(path);
        let snapshots = path.join(SNAPSHOTS);
        files::create_folder(&snapshots).map_err(io_error(CREATE, &snapshots))?;
        // Of two learners that begin at once, the other is refused by the lock. Scores and experience without
        // a configuration are not those of the new run.
        let scores = run.score_log()?;
        if Self::is_occupied(path) || !scores.is_empty() || path.join(EXPERIENCE).exists() {
            return Err(RunDirError::Occupied(path.to_owned()));
        }
        run.clear_failure()?;
        let target = path.join(CONFIG);
        let text = toml::to_string(config).map_err(|error| content(&target, None, error))?;
        files::replace(&target, text.as_bytes()).map_err(io_error("write", &target))?;
        files::synchronize_folder(path).map_err(io_error("write", path))?;
        Ok((run, scores))
    }

    /// The folder, whether or not there is a run in it.
    pub fn at(path: &Path) -> Self {
        Self { path: path.to_owned() }
    }

    /// Opens the folder of a run and reads its configuration.
    pub fn open(path: &Path) -> Result<(Self, RunConfig), RunDirError> {
        let run = Self::at(path);
        let config = run.read_config()?;
        Ok((run, config))
    }

    /// The folder's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// True if a learner is at work in it, by its lock on `scores.jsonl`.
    pub fn is_in_use(&self) -> bool {
        Lock::is_taken(&self.path.join(SCORES))
    }

    /// The file for the error with which a learner of a sweep ends.
    pub fn failure_path(&self) -> PathBuf {
        self.path.join(FAILED)
    }

    /// The error with which the last learner of a sweep has ended; empty if it left none.
    pub fn failure(&self) -> Option<String> {
        let path = self.failure_path();
        path.exists().then(|| files::read_text(&path).unwrap_or_default())
    }

    /// Marks the run as failed.
    pub fn mark_failed(&self, error: &str) -> Result<(), RunDirError> {
        let path = self.failure_path();
        files::replace(&path, error.as_bytes()).map_err(io_error("write", &path))
    }

    /// Removes the mark of an earlier failure.
    pub fn clear_failure(&self) -> Result<(), RunDirError> {
        self.remove(FAILED)
    }

    /// Renames the folder to `NAME.oldN` and returns the new path.
    pub fn set_aside(self) -> Result<PathBuf, RunDirError> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let mut number = 1;
        let aside = loop {
            let candidate = self.path.with_file_name(format!("{name}.old{number}"));
            if !candidate.exists() {
                break candidate;
            }
            number += 1;
        };
        fs::rename(&self.path, &aside).map_err(io_error("rename", &self.path))?;
        Ok(aside)
    }

    /// Reads and checks `config.toml`.
    pub fn read_config(&self) -> Result<RunConfig, RunDirError> {
        let path = self.path.join(CONFIG);
        let text = files::read_text(&path).map_err(io_error("read", &path))?;
        let config: RunConfig = toml::from_str(&text).map_err(|error: toml::de::Error| {
            let before = error.span().and_then(|span| text.get(..span.start));
            let line = before.map(|before| before.matches('\n').count() + 1);
            content(&path, line, error.message())
        })?;
        let check = config.experiment.check_ranges().and_then(|()| config.experiment.definition());
        check.map_err(|error| content(&path, None, error))?;
        Ok(config)
    }

    /// Saves the learner's addresses.
    pub fn write_endpoints(&self, endpoints: &RunEndpoints) -> Result<(), RunDirError> {
        self.write_json(ENDPOINTS, endpoints)
    }

    /// Reads the addresses of the last learner, which may have ended.
    pub fn read_endpoints(&self) -> Result<RunEndpoints, RunDirError> {
        self.read_json(ENDPOINTS)
    }

    /// Removes the addresses of an earlier learner.
    pub fn remove_endpoints(&self) -> Result<(), RunDirError> {
        self.remove(ENDPOINTS)
    }

    fn remove(&self, name: &str) -> Result<(), RunDirError> {
        let path = self.path.join(name);
        let removed = files::optional(fs::remove_file(&path));
        removed.map(drop).map_err(io_error("remove", &path))
    }

    /// Reads a JSON file of the folder.
    pub fn read_json<T: DeserializeOwned>(&self, name: &str) -> Result<T, RunDirError> {
        let path = self.path.join(name);
        let text = files::read_text(&path).map_err(io_error("read", &path))?;
        serde_json::from_str(&text).map_err(|error| content(&path, None, error))
    }

    /// Writes a value as indented JSON. Readers see the old file or the new one, never a part.
    pub fn write_json(&self, name: &str, value: &impl Serialize) -> Result<(), RunDirError> {
        let path = self.path.join(name);
        let text =
            serde_json::to_string_pretty(value).map_err(|error| content(&path, None, error))?;
        files::replace(&path, (text + "\n").as_bytes()).map_err(io_error("write", &path))
    }

    /// The path of the snapshot of a gradient step.
    pub fn snapshot_path(&self, step: u64) -> PathBuf {
        self.path.join(SNAPSHOTS).join(format!("step_{step:09}.safetensors"))
    }

    /// Saves the snapshot of a gradient step, durably.
    pub fn write_snapshot(&self, step: u64, file: &[u8]) -> Result<(), RunDirError> {
        self.make_folder(SNAPSHOTS)?;
        let path = self.snapshot_path(step);
        files::replace(&path, file).map_err(io_error("write", &path))
    }

    /// Makes a folder of the run again that was removed; the run's own folder must exist.
    pub(super) fn make_folder(&self, name: &str) -> Result<(), RunDirError> {
        let folder = self.path.join(name);
        match fs::create_dir(&folder) {
            // Else a power cut could take what will be in it.
            Ok(()) => files::synchronize_folder(&folder).map_err(io_error("write", &folder)),
            Err(error) if error.kind() == ErrorKind::NotFound => {
                Err(RunDirError::Gone(self.path.clone()))
            }
            // It would be written to through the link.
            Err(_) if folder.is_symlink() => Err(io_error("write", &folder)(files::no_file())),
            // The folder exists, or writing into it fails with the reason.
            Err(_) => Ok(()),
        }
    }

    /// Reads the snapshot of a gradient step.
    pub fn read_snapshot(&self, step: u64) -> Result<Vec<u8>, RunDirError> {
        let path = self.snapshot_path(step);
        files::read(&path).map_err(io_error("read", &path))
    }

    /// Renames a snapshot whose hash is not that of its scores, so that it no longer counts.
    pub fn mark_damaged(&self, step: u64) -> Result<(), RunDirError> {
        let path = self.snapshot_path(step);
        fs::rename(&path, path.with_extension("damaged")).map_err(io_error("rename", &path))
    }

    /// Removes files that killed processes have not finished.
    pub fn remove_partial_files(&self) {
        files::remove_partial_files(&self.path);
        for folder in [SNAPSHOTS, CHECKPOINTS].map(|name| self.path.join(name)) {
            if !folder.is_symlink() {
                files::remove_partial_files(&folder);
            }
        }
    }

    /// The gradient steps of the snapshots, in ascending order. Links do not count.
    pub fn snapshots(&self) -> Result<Vec<u64>, RunDirError> {
        let folder = self.path.join(SNAPSHOTS);
        let entries = files::optional(fs::read_dir(&folder)).map_err(io_error("read", &folder))?;
        let step = |entry: io::Result<DirEntry>| {
            let entry = entry.ok()?;
            let name = entry.file_name();
            let step = name.to_str()?.strip_prefix("step_")?;
            let step = step.strip_suffix(".safetensors")?.parse().ok();
            step.filter(|_| entry.file_type().is_ok_and(|kind| kind.is_file()))
        };
        let mut steps: Vec<u64> = entries.into_iter().flatten().filter_map(step).collect();
        steps.sort_unstable();
        Ok(steps)
    }

    /// Opens `scores.jsonl` for appending, locked. Each append is synchronized, so acknowledged
    /// scores survive a crash.
    pub fn score_log(&self) -> Result<Log, RunDirError> {
        let path = self.path.join(SCORES);
        let lock = Lock::take(&path)?;
        Log::open(path, Some(lock))
    }

    /// Opens `metrics.jsonl` for appending and cuts off the lines after `step`, which a resumed run
    /// writes again. Also returns the training seconds of the last line.
    pub fn metrics_log(&self, step: u64) -> Result<(Log, f64), RunDirError> {
        #[derive(Deserialize)]
        struct Line {
            step: u64,
            seconds: f64,
        }
        let mut log = Log::open(self.path.join("metrics.jsonl"), None)?;
        let mut seconds = 0.0;
        log.keep_while(|line| match serde_json::from_str::<Line>(line) {
            Ok(line) if line.step <= step => {
                seconds = line.seconds;
                true
            }
            _ => false,
        })?;
        Ok((log, seconds))
    }

    /// Reads the whole lines of `scores.jsonl`; a missing file has none.
    pub fn read_scores(&self) -> Result<Vec<ScoreLine>, RunDirError> {
        let path = self.path.join(SCORES);
        let text = files::optional(files::read_text(&path)).map_err(io_error("read", &path))?;
        let text = text.unwrap_or_default();
        let whole = &text[..whole_lines(text.as_bytes())];
        let parse = |(index, line): (usize, &str)| {
            serde_json::from_str(line).map_err(|error| content(&path, Some(index + 1), error))
        };
        whole.lines().enumerate().map(parse).collect()
    }

    /// The error for contradictory lines of `scores.jsonl`.
    pub(super) fn broken_scores(&self, reason: String) -> RunDirError {
        content(&self.path.join(SCORES), None, reason)
    }
}

/// Lists the run folders at and below a folder, in alphabetical order. Folders that cannot be read
/// are passed to `unreadable`.
pub fn walk(path: &Path, unreadable: &mut impl FnMut(&Path, io::Error)) -> Vec<PathBuf> {
    if RunDir::is_occupied(path) {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).map_err(|error| unreadable(path, error));
    // Links are not followed: they may lead back.
    let folders = entries
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        .map(|entry| entry.path());
    let folders = BTreeSet::from_iter(folders);
    folders.iter().flat_map(|folder| walk(folder, unreadable)).collect()
}
