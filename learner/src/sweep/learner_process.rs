//! One run of a study: its learner, from the run's folder to what the learner's end means.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};
use std::time::Duration;

use anyhow::Context;
use quad_run::config::tables;
use quad_run::folder::RunDir;
use quad_run::status::{Pace, State};
use quad_runtime::{ENDED_AT_ONCE, FAILURE_FILE, LEAVE_WITHIN, UNFINISHED};
use tokio::task::spawn_blocking;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use super::study::PlannedRun;
use crate::children::{self, Process, hide_certificates};

/// A learner that was told to stop ends within less; one that is frozen is killed. Then there is
/// time for the evaluators to leave before the sweep must have ended.
const LEARNERS_LEAVE: Duration = LEAVE_WITHIN.saturating_add(Duration::from_secs(2));
/// How long a sweep that was told to end waits for what a disk has to say of a learner that has
/// ended.
const LAST_WORDS: Duration = Duration::from_secs(1);

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

/// A run at work.
#[derive(Clone)]
pub(super) struct LearnerProcess {
    pub run: PlannedRun,
    /// The run's folder.
    pub dir: PathBuf,
    /// Steps that were done before.
    pub from: u64,
}

/// How a learner has ended.
pub(super) enum End {
    /// The run is complete.
    Complete,
    /// It was told to stop, or no evaluator came, or another learner is at work in the run's
    /// folder.
    Unfinished,
    /// With an error; what it was, and where its log is.
    Failed(String),
}

impl LearnerProcess {
    /// A run of a study in this folder.
    pub fn new(run: PlannedRun, state: State, study: &Path) -> Self {
        Self { dir: study.join(&run.name), from: state.step(run.experiment.steps), run }
    }

    /// Starts the learner and waits for its end. After `stop` it waits no longer than the learner
    /// may take to save a checkpoint. The system ends the learner with the calling thread. Other
    /// threads read and write the folder: a disk that hangs holds up neither other runs nor Ctrl-C.
    pub async fn run(self, with: Learners, stop: CancellationToken) -> (Self, End, Pace) {
        let begun = Pace { step: self.from, ..Pace::default() };
        let (end, pace) = match self.supervise(with, stop).await {
            Ok(Some(ended)) => ended,
            Ok(None) => (End::Unfinished, begun),
            Err(error) => (End::Failed(format!("{error:#}")), begun),
        };
        (self, end, pace)
    }

    /// `None` if the sweep stops before the learner starts, or before the disk has answered.
    async fn supervise(
        &self,
        with: Learners,
        stop: CancellationToken,
    ) -> anyhow::Result<Option<(End, Pace)>> {
        let this = self.clone();
        let prepared = spawn_blocking(move || this.prepare(&with));
        let Some(prepared) = stop.run_until_cancelled(prepared).await else { return Ok(None) };
        let mut command = prepared??;
        let mut learner = Process::start(&mut command)
            .with_context(|| format!("{}: cannot start a learner", self.run.name))?;
        let status = match stop.run_until_cancelled(learner.wait()).await {
            Some(status) => status,
            None => learner.end(LEARNERS_LEAVE).await,
        };
        let (this, stopped) = (self.clone(), stop.is_cancelled());
        let concluded =
            spawn_blocking(move || (this.conclude(status, stopped), Pace::read(&this.dir)));
        tokio::select! {
            concluded = concluded => Ok(Some(concluded?)),
            () = async { stop.cancelled().await; sleep(LAST_WORDS).await } => Ok(None),
        }
    }

    /// Makes the run's folder and the learner's command.
    fn prepare(&self, with: &Learners) -> anyhow::Result<Command> {
        let Self { run, dir, .. } = self;
        let mut command = Command::new(std::env::current_exe()?);
        command
            .args(["train", "--preset", &run.preset, "--connect", &with.endpoint, "--run-dir"])
            .arg(dir);
        command
            .args(with.http.iter().flat_map(|address| ["--http".to_owned(), address.to_string()]));
        for (key, value) in tables::keys(&run.changes) {
            command.args(["--set", &format!("{key}={value}")]);
        }
        command.env("RAYON_NUM_THREADS", with.threads.to_string());
        hide_certificates(&mut command, &with.endpoint);
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
        let code = status
            .as_ref()
            .ok()
            .and_then(ExitStatus::code)
            .and_then(|code| u8::try_from(code).ok());
        match code {
            Some(0) => return End::Complete,
            Some(UNFINISHED) => return End::Unfinished,
            // It was ended before it could do as it was told; the same command continues all the
            // same.
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
        End::Failed(format!("{}: {reason} ({})", self.run.name, log(&self.dir).display()))
    }
}

fn log(dir: &Path) -> PathBuf {
    dir.join("learner.log")
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::os::unix::process::ExitStatusExt;

    use super::*;
    use crate::sweep::Study;

    #[test]
    fn the_reason_of_a_failure() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mine.toml");
        let text = "about = 'x'\nrun = { task = 'hopper-demo', dataset = 'x.hdf5' }\naxes = { seed = [0] }";
        fs::write(&file, text).unwrap();
        let run = Study::read(&file, &[], &[]).unwrap().runs.remove(0);
        let learner = LearnerProcess::new(run, State::NotBegun, folder.path());
        fs::create_dir_all(&learner.dir).unwrap();
        let killed = || Ok(ExitStatus::from_raw(9));
        for (failure, reason) in [
            (None, "the learner ended by signal: 9 (SIGKILL)"),
            (Some("a loose cable"), "a loose cable"),
        ] {
            let dir = RunDir::at(&learner.dir);
            dir.clear_failure().unwrap();
            if let Some(failure) = failure {
                dir.mark_failed(failure).unwrap();
            }
            let End::Failed(said) = learner.conclude(killed(), false) else { panic!("{reason}") };
            assert!(said.starts_with(&format!("seed0: {reason}")), "{said}");
            assert_eq!(dir.failure().as_deref(), Some(reason));
        }
        assert!(matches!(learner.conclude(killed(), true), End::Unfinished), "it was stopped");
    }
}
