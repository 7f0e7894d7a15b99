//! A learner at work on one run of a study.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};

use anyhow::Context;
use quad_run::config::tables;
use quad_run::run::RunDir;
use quad_run::status::{Pace, State};
use quad_runtime::{ENDED_AT_ONCE, UNFINISHED, error_in};
use rustix::process::{Pid, Signal, kill_process};

use super::study::PlannedRun;
use crate::local_evaluators::{not_encrypted, run_beside};

/// What all learners of a sweep have in common.
#[derive(Clone)]
pub(crate) struct Learners {
    /// Threads of each.
    pub threads: usize,
    /// Where they meet evaluators.
    pub endpoint: String,
    /// Address of the page of a single one.
    pub http: Option<SocketAddr>,
}

/// A run whose folder is there, and the command of its learner.
pub(super) struct Prepared {
    run: PlannedRun,
    dir: PathBuf,
    from: u64,
    /// Bytes that earlier learners have logged.
    logged: u64,
    command: Command,
}

/// A learner's process.
pub(super) struct Job {
    /// Its run.
    pub run: PlannedRun,
    /// The run's folder.
    pub dir: PathBuf,
    /// Steps that were done before.
    pub from: u64,
    /// What it was last seen to have done.
    pub progress: Pace,
    logged: u64,
    process: Child,
    /// Whether it was told to stop.
    stopped: bool,
}

/// How a learner has ended.
pub(super) enum End {
    /// The run is complete.
    Complete,
    /// It was told to stop, or no evaluator came, or another learner is at work in the run's folder.
    Unfinished,
    /// With an error; what it was, and where its log is.
    Failed(String),
}

impl Prepared {
    /// Makes the run's folder.
    ///
    /// # Errors
    /// The folder cannot be written to.
    pub fn new(run: PlannedRun, state: State, dir: PathBuf, with: &Learners) -> anyhow::Result<Self> {
        let from = state.step(run.experiment.steps);
        let mut command = Command::new(std::env::current_exe()?);
        command.args(["train", "--preset", &run.preset, "--connect", &with.endpoint, "--run-dir"]).arg(&dir);
        command.args(with.http.iter().flat_map(|address| ["--http".to_owned(), address.to_string()]));
        for (key, value) in tables::keys(&run.changes) {
            command.args(["--set", &format!("{key}={value}")]);
        }
        command.env("RAYON_NUM_THREADS", with.threads.to_string());
        not_encrypted(&mut command, &with.endpoint);
        fs::create_dir_all(&dir)
            .and_then(|()| run_beside(&mut command, &log(&dir)))
            .with_context(|| format!("{}: cannot write to {}", run.name, dir.display()))?;
        let logged = fs::metadata(log(&dir)).map_or(0, |log| log.len());
        Ok(Self { run, dir, from, logged, command })
    }

    /// Starts the learner. The system ends it with the calling thread.
    ///
    /// # Errors
    /// No process can be made.
    pub fn start(mut self) -> anyhow::Result<Job> {
        let process = self.command.spawn().with_context(|| format!("{}: cannot start a learner", self.run.name))?;
        let Self { run, dir, from, logged, .. } = self;
        let progress = Pace { step: from, ..Pace::default() };
        Ok(Job { run, dir, from, progress, logged, process, stopped: false })
    }
}

impl Job {
    /// How its process has ended, if it has.
    pub fn ended(&mut self) -> Option<io::Result<ExitStatus>> {
        self.process.try_wait().transpose()
    }

    /// Tells it to save a checkpoint and leave.
    pub fn stop(&mut self) {
        self.stopped = true;
        kill_process(Pid::from_child(&self.process), Signal::TERM).ok();
    }

    /// Ends it at once.
    pub fn kill(&mut self) {
        self.process.kill().ok();
    }

    /// What its end means for the run; its last progress is read. Remembers a failure in the run's folder.
    pub fn conclude(&mut self, status: io::Result<ExitStatus>) -> End {
        self.progress = Pace::read(&self.dir);
        let code = status.as_ref().ok().and_then(ExitStatus::code).and_then(|code| u8::try_from(code).ok());
        match code {
            Some(0) => return End::Complete,
            Some(UNFINISHED) => return End::Unfinished,
            // It was ended before it could do as it was told; the same command continues all the same.
            None | Some(ENDED_AT_ONCE) if self.stopped => return End::Unfinished,
            _ => {}
        }
        // On a disk that takes nothing, `--list` calls it begun.
        RunDir::at(&self.dir).mark_failed(true).ok();
        let log = log(&self.dir);
        let text = fs::read(&log).unwrap_or_default();
        let own = String::from_utf8_lossy(text.get(self.logged as usize..).unwrap_or_default());
        let reason = match (error_in(&own), status) {
            (Some(error), _) => error.to_owned(),
            (None, Ok(status)) => format!("the learner ended by {status}"),
            (None, Err(error)) => format!("the learner is lost: {error}"),
        };
        End::Failed(format!("{}: {reason} ({})", self.run.name, log.display()))
    }
}

fn log(dir: &Path) -> PathBuf {
    dir.join("learner.log")
}
