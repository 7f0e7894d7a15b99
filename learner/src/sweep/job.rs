//! One run of a study: its learner, from the run's folder to what the learner's end means.

use std::fs;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus};
use std::time::Duration;

use anyhow::Context;
use quad_run::config::tables;
use quad_run::folder::RunDir;
use quad_run::status::{Pace, State};
use quad_runtime::{ENDED_AT_ONCE, FAILURE_FILE, LEAVE_WITHIN, UNFINISHED};
use rustix::process::{Pid, Signal, kill_process};
use tokio::sync::watch::Receiver;
use tokio::task::spawn_blocking;
use tokio::time::{sleep, timeout};

use super::study::PlannedRun;
use crate::local_evaluators::{not_encrypted, run_beside};

/// How often it looks whether a learner has ended.
pub(super) const GLANCE: Duration = Duration::from_millis(100);
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
pub(super) struct Job {
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

impl Job {
    /// A run of a study in this folder.
    pub fn new(run: PlannedRun, state: State, study: &Path) -> Self {
        Self { dir: study.join(&run.name), from: state.step(run.experiment.steps), run }
    }

    /// Starts the learner and waits for its end; after `stop`, in which it saves a checkpoint, for
    /// no longer than it may take. The system ends the learner with the calling thread. Other
    /// threads read and write the folder: a disk that hangs holds up neither other runs nor Ctrl-C.
    pub async fn see_through(self, with: Learners, stop: Receiver<bool>) -> (Self, End, Pace) {
        let begun = Pace { step: self.from, ..Pace::default() };
        let (end, pace) = self
            .work(with, stop)
            .await
            .unwrap_or_else(|error| (End::Failed(format!("{error:#}")), begun));
        (self, end, pace)
    }

    async fn work(&self, with: Learners, stop: Receiver<bool>) -> anyhow::Result<(End, Pace)> {
        let unfinished = (End::Unfinished, Pace { step: self.from, ..Pace::default() });
        let job = self.clone();
        let mut command = tokio::select! {
            prepared = spawn_blocking(move || job.prepare(&with)) => prepared??,
            () = told(&stop) => return Ok(unfinished),
        };
        let mut learner = command
            .spawn()
            .with_context(|| format!("{}: cannot start a learner", self.run.name))?;
        let status = tokio::select! {
            status = ended(&mut learner) => status,
            () = told(&stop) => {
                kill_process(Pid::from_child(&learner), Signal::TERM).ok();
                if timeout(LEARNERS_LEAVE, ended(&mut learner)).await.is_err() {
                    learner.kill().ok();
                }
                ended(&mut learner).await
            }
        };
        let (job, stopped) = (self.clone(), *stop.borrow());
        let concluded =
            spawn_blocking(move || (job.conclude(status, stopped), Pace::read(&job.dir)));
        tokio::select! {
            concluded = concluded => Ok(concluded?),
            () = async { told(&stop).await; sleep(LAST_WORDS).await } => Ok(unfinished),
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
        not_encrypted(&mut command, &with.endpoint);
        let folder = RunDir::at(dir);
        command.env(FAILURE_FILE, folder.failure_path());
        fs::create_dir_all(dir)
            .and_then(|()| run_beside(&mut command, &log(dir)))
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

/// Waits until the sweep is told to end.
async fn told(stop: &Receiver<bool>) {
    stop.clone().wait_for(|stop| *stop).await.ok();
}

async fn ended(learner: &mut Child) -> io::Result<ExitStatus> {
    loop {
        if let Some(status) = learner.try_wait().transpose() {
            return status;
        }
        sleep(GLANCE).await;
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
        let job = Job::new(run, State::NotBegun, folder.path());
        fs::create_dir_all(&job.dir).unwrap();
        let killed = || Ok(ExitStatus::from_raw(9));
        for (failure, reason) in
            [(None, "the learner ended by signal: 9"), (Some("a loose cable"), "a loose cable")]
        {
            let dir = RunDir::at(&job.dir);
            dir.clear_failure().unwrap();
            failure.into_iter().for_each(|failure| dir.mark_failed(failure).unwrap());
            let End::Failed(said) = job.conclude(killed(), false) else { panic!("{reason}") };
            assert!(said.starts_with(&format!("seed0: {reason}")), "{said}");
            assert_eq!(dir.failure().as_deref(), Some(reason));
        }
        assert!(matches!(job.conclude(killed(), true), End::Unfinished), "it was told to stop");
    }
}
