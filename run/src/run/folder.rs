//! The folder of a run.
//!
//! ```text
//! config.toml                        the resolved configuration
//! endpoints.json                     where this learner can be reached; written as soon as it listens
//! metrics.jsonl                      training metrics, a line every hundred gradient steps
//! scores.jsonl                       a line per scored episode, written before the evaluator gets its acknowledgment
//! snapshots/step_000003000.safetensors   target actor and target critics; written before the evaluation of it begins
//! checkpoints/step_000003000_….safetensors   the newest three states of the training, to continue from
//! report.json, learning_curve.svg    written at the end
//! judgments.json                    what `learner judge` found out about its snapshots
//! ```

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::checkpoints::{Checkpoint, Checkpoints};
use super::error::{CREATE, RunDirError, content, io_error};
use super::lines::{RunEndpoints, ScoreLine};
use super::lock::Lock;
use super::log::Log;
use crate::config::RunConfig;
use crate::files;

/// The file by which a sweep remembers that a run has failed.
const FAILED: &str = "failed";
const SCORES: &str = "scores.jsonl";

/// The folder of one run.
#[derive(Clone, Debug)]
pub struct RunDir {
    path: PathBuf,
}

impl RunDir {
    /// Whether there is a run in the folder.
    pub fn is_occupied(path: &Path) -> bool {
        path.join("config.toml").exists()
    }

    /// Makes the folder, locks it and saves the configuration; also gives `scores.jsonl`, which
    /// holds the lock.
    ///
    /// # Errors
    /// There is a run in it, another learner is just making one, or it cannot be written to.
    pub fn create(path: &Path, config: &RunConfig) -> Result<(Self, Log), RunDirError> {
        let occupied = || RunDirError::Occupied(path.to_owned());
        if Self::is_occupied(path) {
            return Err(occupied());
        }
        let run = Self::at(path);
        let snapshots = path.join("snapshots");
        files::create_folder(&snapshots).map_err(io_error(CREATE, &snapshots))?;
        // Of two that begin at once, only one gets past this; and scores of unknown origin are not
        // those of a new run.
        let scores = run.score_log()?;
        if Self::is_occupied(path) || !scores.is_empty() {
            return Err(occupied());
        }
        run.mark_failed(false)?;
        let target = path.join("config.toml");
        let text = toml::to_string(config).map_err(|error| content(&target, None, &error))?;
        files::replace(&target, text.as_bytes()).map_err(io_error("write", &target))?;
        files::synchronize_folder(path).map_err(io_error("write", path))?;
        Ok((run, scores))
    }

    /// The folder, whatever is in it.
    pub fn at(path: &Path) -> Self {
        Self { path: path.to_owned() }
    }

    /// Whether a learner is at work in it, by its lock on `scores.jsonl`.
    pub fn is_in_use(&self) -> bool {
        Lock::is_taken(&self.path.join(SCORES))
    }

    /// Remembers that a run of a sweep has failed, or forgets it.
    pub fn mark_failed(&self, failed: bool) -> Result<(), RunDirError> {
        let path = self.path.join(FAILED);
        let marked =
            if failed { files::replace(&path, b"") } else { files::remove_if_there(&path) };
        marked.map_err(io_error("write", &path))
    }

    /// Whether it is remembered that it has.
    pub fn has_failed(&self) -> bool {
        self.path.join(FAILED).exists()
    }

    /// Renames the folder to one that says that it is older; gives the new path.
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

    /// A folder that a learner has written; reads its configuration.
    pub fn open(path: &Path) -> Result<(Self, RunConfig), RunDirError> {
        let run = Self::at(path);
        let config = run.read_config()?;
        Ok((run, config))
    }

    /// The configuration that the run began with.
    pub fn read_config(&self) -> Result<RunConfig, RunDirError> {
        let source = self.path.join("config.toml");
        let text = files::read_text(&source).map_err(io_error("read", &source))?;
        let config: RunConfig = toml::from_str(&text).map_err(|error: toml::de::Error| {
            let line = error
                .span()
                .and_then(|at| text.get(..at.start))
                .map(|before| before.matches('\n').count() + 1);
            content(&source, line, &error.message())
        })?;
        config.experiment.check_ranges().map_err(|error| content(&source, None, &error))?;
        Ok(config)
    }

    /// The folder's path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Where the picture of the learning curve goes.
    pub fn learning_curve(&self) -> PathBuf {
        self.path.join("learning_curve.svg")
    }

    /// Says where the learner can be reached.
    pub fn write_endpoints(&self, endpoints: &RunEndpoints) -> Result<(), RunDirError> {
        self.write_json("endpoints.json", endpoints)
    }

    /// Where the learner can be reached that wrote so last, at work or not.
    pub fn read_endpoints(&self) -> Result<RunEndpoints, RunDirError> {
        self.read_json("endpoints.json")
    }

    /// Forgets where an earlier learner could be reached.
    pub fn remove_endpoints(&self) -> Result<(), RunDirError> {
        let path = self.path.join("endpoints.json");
        files::remove_if_there(&path).map_err(io_error("remove", &path))
    }

    /// Reads a JSON file of the folder.
    ///
    /// # Errors
    /// It cannot be read, or is something else.
    pub fn read_json<T: DeserializeOwned>(&self, name: &str) -> Result<T, RunDirError> {
        let path = self.path.join(name);
        let text = files::read_text(&path).map_err(io_error("read", &path))?;
        serde_json::from_str(&text).map_err(|error| content(&path, None, &error))
    }

    /// Writes a value as indented JSON; a reader sees the old file or the new one, never half of
    /// it.
    pub fn write_json(&self, name: &str, value: &impl Serialize) -> Result<(), RunDirError> {
        let path = self.path.join(name);
        let mut text =
            serde_json::to_string_pretty(value).map_err(|error| content(&path, None, &error))?;
        text.push('\n');
        files::replace(&path, text.as_bytes()).map_err(io_error("write", &path))
    }

    /// Where the snapshot of a gradient step is or will be.
    pub fn snapshot_path(&self, step: u64) -> PathBuf {
        self.path.join("snapshots").join(format!("step_{step:09}.safetensors"))
    }

    /// Saves the snapshot of a gradient step. It survives a power cut from then on.
    pub fn write_snapshot(&self, step: u64, tensors: &[u8]) -> Result<(), RunDirError> {
        self.make_folder("snapshots")?;
        let path = self.snapshot_path(step);
        files::replace(&path, tensors).map_err(io_error("write", &path))
    }

    /// Makes a folder of the run again that was removed, but not the run's own.
    fn make_folder(&self, name: &str) -> Result<(), RunDirError> {
        let folder = self.path.join(name);
        match fs::create_dir(&folder) {
            // Else a power cut could take what will be in it.
            Ok(()) => files::synchronize_folder(&folder).map_err(io_error("write", &folder)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Err(RunDirError::Gone(self.path.clone()))
            }
            // It would be written to through the link.
            Err(_) if folder.is_symlink() => Err(io_error("write", &folder)(files::no_file())),
            // There it is, or writing into it will say what is wrong.
            Err(_) => Ok(()),
        }
    }

    /// Reads the snapshot of a gradient step.
    pub fn read_snapshot(&self, step: u64) -> Result<Vec<u8>, RunDirError> {
        let path = self.snapshot_path(step);
        files::read(&path).map_err(io_error("read", &path))
    }

    /// Renames a snapshot whose contents are not what was scored, so that it does not count as one
    /// any more.
    pub fn mark_damaged(&self, step: u64) -> Result<(), RunDirError> {
        let path = self.snapshot_path(step);
        fs::rename(&path, path.with_extension("damaged")).map_err(io_error("rename", &path))
    }

    /// Removes what writers that were killed have left behind.
    pub fn remove_partial_files(&self) {
        files::remove_partial_files(&self.path);
        let folders = ["snapshots", "checkpoints"].map(|name| self.path.join(name));
        folders
            .iter()
            .filter(|folder| !folder.is_symlink())
            .for_each(|folder| files::remove_partial_files(folder));
    }

    /// The gradient steps of which there are snapshots, in ascending order; a link is none.
    pub fn snapshots(&self) -> Result<Vec<u64>, RunDirError> {
        let folder = self.path.join("snapshots");
        let entries = match fs::read_dir(&folder) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries.map_err(io_error("read", &folder))?,
        };
        let step = |entry: io::Result<fs::DirEntry>| {
            let entry =
                entry.ok().filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()))?;
            entry
                .file_name()
                .to_str()?
                .strip_prefix("step_")?
                .strip_suffix(".safetensors")?
                .parse()
                .ok()
        };
        let mut steps: Vec<u64> = entries.filter_map(step).collect();
        steps.sort_unstable();
        Ok(steps)
    }

    /// Saves a state of the training, durably, and removes those that are older than the newest
    /// three.
    pub fn write_checkpoint(&self, checkpoint: &Checkpoint) -> Result<(), RunDirError> {
        self.make_folder("checkpoints")?;
        Checkpoints::of_run(&self.path).save(checkpoint)
    }

    /// The newest state of the training that is not damaged; none if there is none.
    pub fn newest_checkpoint(&self) -> Result<Option<Checkpoint>, RunDirError> {
        Checkpoints::of_run(&self.path).newest()
    }

    /// `scores.jsonl`, opened for appending and locked. Each append is synchronized, so
    /// acknowledged scores survive a crash.
    ///
    /// # Errors
    /// [`RunDirError::InUse`] if another learner works in this folder.
    pub fn score_log(&self) -> Result<Log, RunDirError> {
        let path = self.path.join(SCORES);
        let lock = Lock::take(&path)?;
        Log::open(path, Some(lock))
    }

    /// `metrics.jsonl`, opened for appending, without the lines after `step`: a learner that
    /// continues from there writes them again. Also gives the seconds of training that its last
    /// line tells.
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

    /// The lines of `scores.jsonl`; none if nothing was scored yet. A last line that is not
    /// complete yet is left out.
    pub fn read_scores(&self) -> Result<Vec<ScoreLine>, RunDirError> {
        let path = self.path.join(SCORES);
        let text = match files::read_text(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            other => other.map_err(io_error("read", &path))?,
        };
        let complete = text.rfind('\n').map_or("", |end| &text[..end]);
        let parse = |(index, line): (usize, &str)| {
            serde_json::from_str(line).map_err(|error| content(&path, Some(index + 1), &error))
        };
        complete.lines().enumerate().map(parse).collect()
    }

    /// The error for `scores.jsonl` whose lines do not go together.
    pub fn broken_scores(&self, reason: String) -> RunDirError {
        content(&self.path.join(SCORES), None, &reason)
    }
}
