//! The learner of one run of a study.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};
use std::time::Duration;

use anyhow::Context;
use quad_run::config::{presets, tables};
use quad_run::folder::RunDir;
use quad_run::status::{Pace, State};
use quad_runtime::{ENDED_AT_ONCE, FAILURE_FILE, LEAVE_WITHIN, UNFINISHED};
use tokio::task::spawn_blocking;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use super::study::PlannedRun;
use crate::children::{self, Process, hide_certificates};

/// Time limit for a learner to stop, before it is killed. The evaluators have time to leave before
/// the sweep must have ended.
const STOP_LIMIT: Duration = LEAVE_WITHIN.saturating_add(Duration::from_secs(2));
/// Time limit for the last read of a run's folder while the sweep stops.
const LAST_READ: Duration = Duration::from_secs(1);

#[derive(Clone)]
pub(crate) struct LearnerOptions {
    pub threads: usize,
    pub endpoint: String,
    /// Address of the page, for a single learner.
    pub http: Option<SocketAddr>,
}

#[derive(Clone)]
pub(super) struct LearnerProcess {
    pub run: PlannedRun,
    pub dir: PathBuf,
    /// Steps that earlier learners have done.
    pub from: u64,
}

pub(super) enum End {
    Complete,
    /// It was stopped, or no evaluator came, or another learner has the run's folder.
    Unfinished,
    /// The error, and the path of the log.
    Failed(String),
}

impl LearnerProcess {
    pub fn new(run: PlannedRun, state: State, study: &Path) -> Self {
        let (dir, steps) = (study.join(&run.name), run.experiment.total_steps());
        Self { run, dir, from: state.step(steps) }
    }

    /// Runs the learner to its end, or stops it. The system ends the learner with the calling
    /// thread. Other threads read and write the folder: a hanging disk blocks neither other runs
    /// nor Ctrl-C.
    pub async fn run(self, options: LearnerOptions, stop: CancellationToken) -> (Self, End, Pace) {
        let begun = Pace { step: self.from, ..Pace::default() };
        let ended = self.supervise(options, stop).await.unwrap_or_else(|error| {
            let reason = format!("{error:#}");
            Some((End::Failed(reason), begun))
        });
        let (end, pace) = ended.unwrap_or((End::Unfinished, begun));
        (self, end, pace)
    }

    /// `None` if the sweep stops before the learner starts, or before the disk has answered.
    async fn supervise(
        &self,
        options: LearnerOptions,
        stop: CancellationToken,
    ) -> anyhow::Result<Option<(End, Pace)>> {
        let this = self.clone();
        let prepared = spawn_blocking(move || this.prepare(&options));
        let prepared = stop.run_until_cancelled(prepared).await;
        let Some(prepared) = prepared else { return Ok(None) };
        let mut command = prepared??;
        let mut learner = Process::start(&mut command)
            .with_context(|| format!("{}: cannot start a learner", self.run.name))?;
        let status = match stop.run_until_cancelled(learner.wait()).await {
            Some(status) => status,
            None => learner.end(STOP_LIMIT).await,
        };
        let (this, stopped) = (self.clone(), stop.is_cancelled());
        let concluded =
            spawn_blocking(move || (this.conclude(status, stopped), Pace::read(&this.dir)));
        tokio::select! {
            concluded = concluded => Ok(Some(concluded?)),
            () = async { stop.cancelled().await; sleep(LAST_READ).await } => Ok(None),
        }
    }

    fn prepare(&self, options: &LearnerOptions) -> anyhow::Result<Command> {
        let Self { run, dir, .. } = self;
        let mut command = Command::new(std::env::current_exe()?);
        let named = if presets::is_path(&run.preset) { "--preset" } else { "--task" };
        command.args(["train", named, &run.preset, "--connect", &options.endpoint, "--run-dir"]);
        command.arg(dir);
        if let Some(address) = options.http {
            command.args(["--http", &address.to_string()]);
        }
        for (key, value) in tables::keys(&run.changes) {
            command.args(["--set", &format!("{key}={value}")]);
        }
        command.env("RAYON_NUM_THREADS", options.threads.to_string());
        hide_certificates(&mut command, &options.endpoint);
        let folder = RunDir::at(dir);
        command.env(FAILURE_FILE, folder.failure_path());
        fs::create_dir_all(dir)
            .and_then(|()| children::prepare(&mut command, &log(dir)))
            .with_context(|| format!("{}: cannot write to {}", run.name, dir.display()))?;
        folder.clear_failure()?;
        Ok(command)
    }

    /// Translates the learner's end. Marks a failed run in its folder.
    fn conclude(&self, status: io::Result<ExitStatus>, stopped: bool) -> End {
        let code = status.as_ref().ok().and_then(ExitStatus::code);
        match code.and_then(|code| u8::try_from(code).ok()) {
            Some(0) => return End::Complete,
            Some(UNFINISHED) => return End::Unfinished,
            // It ended before it could stop by itself; the same command continues.
            None | Some(ENDED_AT_ONCE) if stopped => return End::Unfinished,
            _ => {}
        }
        let dir = RunDir::at(&self.dir);
        let left = dir.failure().filter(|reason| !reason.is_empty());
        let reason = left.unwrap_or_else(|| {
            let reason = match status {
                Ok(status) => format!("the learner ended by {status}"),
                Err(error) => format!("the learner is lost: {error}"),
            };
            // On a full disk, `--list` shows the run as begun.
            dir.mark_failed(&reason).ok();
            reason
        });
        let (name, log) = (&self.run.name, log(&self.dir));
        End::Failed(format!("{name}: {reason} ({})", log.display()))
    }
}

fn log(dir: &Path) -> PathBuf {
    dir.join("learner.log")
}
