//! A learner at work on one run of a study.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};

use anyhow::Context;
use quad_run::config::tables;
use quad_run::run::RunDir;
use quad_run::status::State;
use quad_runtime::UNFINISHED;
use rustix::process::{Pid, Signal, kill_process};

use super::study::PlannedRun;
use crate::local_evaluators::{not_encrypted, spawn_logged};

/// What a line that says why a learner has failed begins with.
const ERROR: &str = "error: ";

/// A learner's process.
pub(super) struct Job {
    /// Its run.
    pub run: PlannedRun,
    /// The run's folder.
    pub dir: PathBuf,
    /// Steps that were done before.
    pub from: u64,
    process: Child,
}

/// How a learner has ended.
pub(super) enum End {
    /// The run is complete.
    Complete,
    /// It was told to stop, or no evaluator came.
    Unfinished,
    /// With an error; what it was, and where its log is.
    Failed(String),
}

impl Job {
    /// Starts a learner that meets its evaluators at this endpoint and has so many threads.
    ///
    /// # Errors
    /// The folder cannot be written to, or no process be made.
    pub fn start(run: PlannedRun, state: State, dir: PathBuf, endpoint: &str, threads: usize) -> anyhow::Result<Self> {
        let from = state.step(run.experiment.steps);
        fs::create_dir_all(&dir)
            .and_then(|()| RunDir::at(&dir).mark_failed(false))
            .with_context(|| format!("cannot write to {}", dir.display()))?;
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["train", "--preset", &run.preset, "--connect", endpoint, "--run-dir"]).arg(&dir);
        for (key, value) in tables::keys(&run.changes) {
            command.args(["--set", &format!("{key}={value}")]);
        }
        command.env("RAYON_NUM_THREADS", threads.to_string());
        not_encrypted(&mut command, endpoint);
        let process = spawn_logged(&mut command, &log(&dir)).with_context(|| format!("cannot start {command:?}"))?;
        Ok(Self { run, dir, from, process })
    }

    /// How it has ended, if it has.
    pub fn ended(&mut self) -> Option<End> {
        let status = self.process.try_wait().ok().flatten()?;
        Some(match status.code() {
            Some(0) => End::Complete,
            Some(code) if code == i32::from(UNFINISHED) => End::Unfinished,
            _ => {
                // On a disk that takes nothing, `--list` calls it begun.
                RunDir::at(&self.dir).mark_failed(true).ok();
                let log = log(&self.dir);
                let reason = reason(&log).unwrap_or_else(|| format!("the learner ended by {status}"));
                End::Failed(format!("{}: {reason} ({})", self.run.name, log.display()))
            }
        })
    }

    /// Tells it to save a checkpoint and leave.
    pub fn stop(&self) {
        kill_process(Pid::from_child(&self.process), Signal::TERM).ok();
    }
}

fn log(dir: &Path) -> PathBuf {
    dir.join("learner.log")
}

/// The error that a log ends with.
fn reason(log: &Path) -> Option<String> {
    let text = fs::read_to_string(log).ok()?;
    let end: Vec<&str> = text.lines().rev().take(5).collect();
    end.iter().find_map(|line| line.strip_prefix(ERROR)).map(str::to_owned)
}
