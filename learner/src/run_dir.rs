//! The folder of a run: everything that is kept of it.
//!
//! ```text
//! config.toml                        the resolved configuration
//! endpoints.json                     where this learner can be reached; written as soon as it listens
//! metrics.jsonl                      training metrics, a line every hundred gradient steps
//! scores.jsonl                       a line per scored episode, written before the evaluator gets its acknowledgement
//! snapshots/step_000003000.safetensors   target actor and target critics
//! report.json, learning_curve.svg    written at the end
//! ```

use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use quad_protocol::{EpisodeScore, ScoreReport};
use serde::{Deserialize, Serialize};

use crate::config::RunConfig;

/// A run folder that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum RunDirError {
    /// There is a run in it.
    #[error("there is already a run in {0}")]
    Occupied(PathBuf),
    /// Reading or writing failed.
    #[error("cannot {action} {path}")]
    Io {
        /// The operation: "read", "write" …
        action: &'static str,
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file of the run has contents that no learner writes.
    #[error("{path}{} is not what a learner writes: {reason}", line.map(|n| format!(", line {n},")).unwrap_or_default())]
    Content {
        /// Which file.
        path: PathBuf,
        /// Which line, from 1.
        line: Option<usize>,
        /// What is wrong.
        reason: String,
    },
}

/// Where a learner can be reached: `endpoints.json`.
#[derive(Debug, Serialize)]
pub struct RunEndpoints {
    /// Zenoh endpoints that an evaluator can connect to.
    pub zenoh: Vec<String>,
    /// Address of `/metrics`.
    pub metrics: String,
}

/// A line of `scores.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreLine {
    /// Gradient step of the evaluated snapshot.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Undiscounted return.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Environment steps.
    pub length: u32,
    /// D4RL-normalised score.
    pub score: f64,
    /// BLAKE3 of the snapshot's file.
    pub weights: String,
    /// Arithmetic that the policy was computed in; lines from before there was a choice do not say.
    #[serde(default)]
    pub precision: String,
    /// Who measured it.
    pub evaluator: String,
}

impl ScoreLine {
    /// The line for an episode of a report.
    pub fn new(report: &ScoreReport, score: &EpisodeScore) -> Self {
        Self {
            step: report.step,
            seed: score.seed,
            episode_return: score.episode_return,
            length: score.length,
            score: score.score,
            weights: report.weights.to_string(),
            precision: report.precision.to_string(),
            evaluator: report.evaluator.to_string(),
        }
    }
}

/// The folder of one run.
#[derive(Clone, Debug)]
pub struct RunDir {
    path: PathBuf,
}

impl RunDir {
    /// Fails if there is a run in the folder, as [`create`](Self::create) would, but changes nothing.
    pub fn check_free(path: &Path) -> Result<(), RunDirError> {
        if path.join("config.toml").exists() { Err(RunDirError::Occupied(path.to_owned())) } else { Ok(()) }
    }

    /// Makes the folder and saves the configuration.
    pub fn create(path: &Path, config: &RunConfig) -> Result<Self, RunDirError> {
        Self::check_free(path)?;
        let run = Self { path: path.to_owned() };
        let snapshots = path.join("snapshots");
        fs::create_dir_all(&snapshots).map_err(io_error("create", &snapshots))?;
        let target = path.join("config.toml");
        let text = toml::to_string(config).map_err(|error| content(&target, None, &error))?;
        replace(&target, text.as_bytes())?;
        Ok(run)
    }

    /// A folder that a learner has written; reads its configuration.
    pub fn open(path: &Path) -> Result<(Self, RunConfig), RunDirError> {
        let source = path.join("config.toml");
        let text = fs::read_to_string(&source).map_err(io_error("read", &source))?;
        let config = toml::from_str(&text).map_err(|error| content(&source, None, &error))?;
        Ok((Self { path: path.to_owned() }, config))
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

    /// Writes a value as indented JSON; a reader sees the old file or the new one, never half of it.
    pub fn write_json(&self, name: &str, value: &impl Serialize) -> Result<(), RunDirError> {
        let path = self.path.join(name);
        let mut text = serde_json::to_string_pretty(value).map_err(|error| content(&path, None, &error))?;
        text.push('\n');
        replace(&path, text.as_bytes())
    }

    fn snapshot_path(&self, step: u64) -> PathBuf {
        self.path.join("snapshots").join(format!("step_{step:09}.safetensors"))
    }

    /// Saves the snapshot of a gradient step.
    pub fn write_snapshot(&self, step: u64, tensors: &[u8]) -> Result<(), RunDirError> {
        replace(&self.snapshot_path(step), tensors)
    }

    /// Reads the snapshot of a gradient step.
    pub fn read_snapshot(&self, step: u64) -> Result<Vec<u8>, RunDirError> {
        let path = self.snapshot_path(step);
        fs::read(&path).map_err(io_error("read", &path))
    }

    /// `scores.jsonl`, opened for appending. Each append is synchronised, so acknowledged scores survive a crash.
    pub fn score_log(&self) -> Result<Log, RunDirError> {
        Log::open(self.path.join("scores.jsonl"), true)
    }

    /// `metrics.jsonl`, opened for appending.
    pub fn metrics_log(&self) -> Result<Log, RunDirError> {
        Log::open(self.path.join("metrics.jsonl"), false)
    }

    /// The lines of `scores.jsonl`; none if nothing was scored yet. A last line that is not complete yet is left out.
    pub fn read_scores(&self) -> Result<Vec<ScoreLine>, RunDirError> {
        let path = self.path.join("scores.jsonl");
        let text = match fs::read_to_string(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            other => other.map_err(io_error("read", &path))?,
        };
        let complete = text.rfind('\n').map_or("", |end| &text[..end]);
        let parse = |(index, line): (usize, &str)| {
            serde_json::from_str(line).map_err(|error| content(&path, Some(index + 1), &error))
        };
        complete.lines().enumerate().map(parse).collect()
    }
}

/// A file of JSON lines that only grows.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    file: File,
    length: u64,
    synchronise: bool,
}

impl Log {
    fn open(path: PathBuf, synchronise: bool) -> Result<Self, RunDirError> {
        let opened = OpenOptions::new().create(true).append(true).open(&path);
        let file = opened.map_err(io_error("open", &path))?;
        let length = file.metadata().map_err(io_error("open", &path))?.len();
        Ok(Self { path, file, length, synchronise })
    }

    /// Appends lines: all of them, or none if it fails.
    pub fn append<T: Serialize>(&mut self, lines: &[T]) -> Result<(), RunDirError> {
        let mut text = Vec::new();
        for line in lines {
            serde_json::to_writer(&mut text, line).map_err(|error| content(&self.path, None, &error))?;
            text.push(b'\n');
        }
        let written = self.file.write_all(&text).and_then(|()| match self.synchronise {
            true => self.file.sync_data(),
            false => Ok(()),
        });
        if let Err(error) = written {
            // Half a line would make the next one unreadable.
            self.file.set_len(self.length).ok();
            return Err(io_error("write", &self.path)(error));
        }
        self.length += text.len() as u64;
        Ok(())
    }
}

/// Writes beside the target, then renames.
fn replace(target: &Path, bytes: &[u8]) -> Result<(), RunDirError> {
    let mut name = target.file_name().unwrap_or_default().to_owned();
    name.push(".partial");
    let partial = target.with_file_name(name);
    let written = fs::write(&partial, bytes).and_then(|()| fs::rename(&partial, target));
    written.map_err(io_error("write", target))
}

fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> RunDirError {
    let path = path.to_owned();
    move |source| RunDirError::Io { action, path, source }
}

fn content(path: &Path, line: Option<usize>, error: &dyn std::fmt::Display) -> RunDirError {
    RunDirError::Content { path: path.to_owned(), line, reason: error.to_string() }
}
