//! Child processes that end with this one: the evaluators of a learner or a sweep, and the learners
//! of a sweep.

use std::io::{self, ErrorKind};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitStatus, Stdio};
use std::time::Duration;

use quad_run::files;
use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};
use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::timeout;

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
