//! Child processes that end with this one: the evaluators of a learner or a sweep (`--evaluators N`),
//! and the learners of a sweep.

use std::io::{self, ErrorKind};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use quad_protocol::Name;
use quad_run::files;
use quad_runtime::{Hint, requested_threads};
use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};
use tokio::task::{JoinHandle, JoinSet, spawn_blocking};
use tokio::time::{sleep, timeout};
use tokio_util::sync::CancellationToken;

const EVALUATOR: &str = "evaluator";
/// An evaluator delivers its scores and leaves within two seconds; the learner kills it after this
/// time.
const LEAVE: Duration = Duration::from_secs(4);
/// First and longest pause before an evaluator that has ended is started again.
const PAUSE: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(300)];
/// Time limit for a killed process to disappear; one that waits for a hanging disk does not.
const KILLED: Duration = Duration::from_secs(1);

/// A child process. The system ends it with the thread that started it.
pub(crate) struct Process {
    pid: Pid,
    status: JoinHandle<io::Result<ExitStatus>>,
}

impl Process {
    pub fn start(command: &mut Command) -> io::Result<Self> {
        let mut child = command.spawn()?;
        let pid = Pid::from_child(&child);
        let status = spawn_blocking(move || child.wait());
        Ok(Self { pid, status })
    }

    /// Waits for the end of the process. Cancel safe.
    pub async fn wait(&mut self) -> io::Result<ExitStatus> {
        (&mut self.status).await?
    }

    /// Sends SIGTERM, and SIGKILL after a time limit.
    pub async fn end(mut self, limit: Duration) -> io::Result<ExitStatus> {
        for (signal, limit) in [(Signal::TERM, limit), (Signal::KILL, KILLED)] {
            kill_process(self.pid, signal).ok();
            if let Ok(status) = timeout(limit, self.wait()).await {
                return status;
            }
        }
        Err(ErrorKind::TimedOut.into())
    }
}

/// Prepares a command for [`Process::start`]: its output is appended to a log file, it does not get
/// a terminal's Ctrl-C, and it ends with the thread that starts it.
pub(crate) fn prepare(command: &mut Command, log: &Path) -> io::Result<()> {
    let file = files::append(log)?;
    command.stdin(Stdio::null()).stdout(file.try_clone()?);
    command.stderr(file).process_group(0);
    // SAFETY: the new process makes one system call, which may be made between fork and exec.
    #[allow(unsafe_code)]
    unsafe {
        command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::TERM))?));
    }
    Ok(())
}

/// Hides the user's certificates from a program that connects to an endpoint without encryption,
/// which would refuse them.
pub(crate) fn hide_certificates(command: &mut Command, endpoint: &str) {
    if endpoint.starts_with("tcp/") {
        command.env_remove("QUAD_CERTIFICATES");
    }
}

/// The evaluator beside the learner, else the one on the PATH.
pub(crate) fn evaluator_program() -> io::Result<PathBuf> {
    let program = std::env::current_exe()?.with_file_name(EVALUATOR);
    Ok(if program.exists() { program } else { EVALUATOR.into() })
}

/// Evaluators that the learner or a sweep starts itself.
#[derive(Default)]
pub(crate) struct LocalEvaluators {
    count: usize,
    /// Cores for all evaluators together.
    cores: usize,
    program: PathBuf,
    log: Option<PathBuf>,
    running: JoinSet<()>,
    stop: CancellationToken,
}

impl LocalEvaluators {
    /// Prepares `count` evaluators, which share `cores` cores. Does not start them.
    pub fn new(count: usize, cores: usize) -> anyhow::Result<Self> {
        if count == 0 {
            return Ok(Self::default());
        }
        let program = evaluator_program()?;
        let output = Command::new(&program)
            .arg("--version")
            .output()
            .context("there is no program `evaluator` beside the learner or on the PATH")
            .hint(
                "build it with `cargo build --release --package quad-evaluator`, or start some by hand and give \
                 --evaluators 0",
            )?;
        if !output.status.success() {
            let reason = String::from_utf8_lossy(&output.stderr).trim().to_owned();
            let (program, status) = (program.display(), output.status);
            return Err(anyhow!("{program} cannot be started ({status}): {reason}"))
                .hint("if it lacks libmujoco: deploy/setup.sh installs that");
        }
        Ok(Self { count, cores, program, ..Self::default() })
    }

    /// Starts the evaluators, and others in place of those that end by themselves, and reports
    /// each end. They connect to the first of these endpoints, write their logs into a folder, and
    /// are named after `owner`, the run or study: several learners may meet at one router.
    ///
    /// Needs a `LocalSet` on the main thread: the system ends the evaluators with their thread.
    pub fn start(
        &mut self,
        endpoints: &[String],
        folder: &Path,
        owner: &str,
        report: impl Fn(String) + Clone + 'static,
    ) -> anyhow::Result<()> {
        for number in (1..=self.count).rev() {
            let log = folder.join(format!("{EVALUATOR}-{number}.log"));
            let name = Name::new(format!("{owner}-{EVALUATOR}-{number}")).ok();
            let mut command = self.command(endpoints, name);
            prepare(&mut command, &log)
                .with_context(|| format!("an evaluator cannot log to {}", log.display()))?;
            let (stop, report) = (self.stop.clone(), report.clone());
            let running = keep_running(command, log.clone(), stop, report);
            self.running.spawn_local(running);
            self.log = Some(log);
        }
        Ok(())
    }

    /// The command of an evaluator. Without a name, as where that would be too long, it chooses one
    /// that no other has.
    fn command(&self, endpoints: &[String], name: Option<Name>) -> Command {
        let mut command = Command::new(&self.program);
        command.arg("serve");
        if let Some(name) = name {
            command.args(["--name", name.as_str()]);
        }
        if let Some(endpoint) = endpoints.first() {
            command.args(["--connect", endpoint]);
            hide_certificates(&mut command, endpoint);
        }
        if requested_threads().is_none() {
            let share = self.cores.div_ceil(self.count);
            command.env("RAYON_NUM_THREADS", share.to_string());
        }
        command
    }

    /// The log of the first evaluator, once it is started.
    pub fn log(&self) -> Option<&Path> {
        self.log.as_deref()
    }

    /// Asks the evaluators to leave, and waits until they have.
    pub async fn end(&mut self) {
        self.stop.cancel();
        while self.running.join_next().await.is_some() {}
    }
}

/// Starts an evaluator again whenever it ends, until `stop`.
async fn keep_running(
    mut command: Command,
    log: PathBuf,
    stop: CancellationToken,
    report: impl Fn(String),
) {
    let mut pause = Duration::ZERO;
    loop {
        let start = Instant::now();
        let end = match Process::start(&mut command) {
            Ok(mut process) => match stop.run_until_cancelled(process.wait()).await {
                Some(Ok(status)) => format!("has ended ({status})"),
                Some(Err(error)) => format!("is lost ({error})"),
                None => return drop(process.end(LEAVE).await),
            },
            Err(error) => format!("cannot be started ({error})"),
        };
        pause = next_pause(pause, start.elapsed());
        let (seconds, log) = (pause.as_secs(), log.display());
        report(format!(
            "an evaluator {end}; another takes its place in {seconds} s; their log is {log}"
        ));
        if stop.run_until_cancelled(sleep(pause)).await.is_none() {
            return;
        }
    }
}

/// Doubles the pause after each end, unless the evaluator has worked for long.
fn next_pause(pause: Duration, lasted: Duration) -> Duration {
    if lasted >= PAUSE[1] { PAUSE[0] } else { (2 * pause).clamp(PAUSE[0], PAUSE[1]) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_evaluator_that_keeps_ending_is_started_less_and_less_often() {
        let mut pause = Duration::ZERO;
        for seconds in [1, 2, 4, 8, 16, 32, 64, 128, 256, 300, 300] {
            pause = next_pause(pause, Duration::from_secs(1));
            assert_eq!(pause.as_secs(), seconds);
        }
        assert_eq!(next_pause(pause, PAUSE[1]), PAUSE[0], "after long work");
    }
}
