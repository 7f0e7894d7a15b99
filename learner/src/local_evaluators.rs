//! Evaluators that the learner or a sweep starts itself, and that end with it: `--evaluators N`.

use std::fs::File;
use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use quad_runtime::Hint;
use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};

/// The program.
const EVALUATOR: &str = "evaluator";
/// An evaluator delivers its scores and leaves within two seconds; the learner kills it after this time.
const LEAVE: Duration = Duration::from_secs(4);
const GLANCE: Duration = Duration::from_millis(20);

/// Sets up a command so that its process ends with the thread that starts it. The process does not get a terminal's Ctrl-C; its
/// parent tells it to leave.
fn end_with_parent(command: &mut Command) {
    command.stdin(Stdio::null()).process_group(0);
    // SAFETY: the new process makes one system call, which may be made between fork and exec.
    #[allow(unsafe_code)]
    unsafe {
        command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::TERM))?));
    }
}

/// Hides the user's certificates from a program that connects to an endpoint without encryption, which would refuse them.
pub(crate) fn not_encrypted(command: &mut Command, endpoint: &str) {
    if endpoint.starts_with("tcp/") {
        command.env_remove("QUAD_CERTIFICATES");
    }
}

/// Starts a process that ends with this thread, and appends all its output to a file.
pub(crate) fn spawn_logged(command: &mut Command, log: &Path) -> io::Result<Child> {
    end_with_parent(command);
    let file = File::options().create(true).append(true).open(log)?;
    command.stdout(file.try_clone()?).stderr(file).spawn()
}

/// The evaluators to start, and those that run.
#[derive(Default)]
pub(crate) struct LocalEvaluators {
    count: usize,
    /// Cores for all evaluators together.
    cores: usize,
    program: PathBuf,
    started: Vec<Started>,
}

struct Started {
    process: Child,
    log: PathBuf,
    /// Whether the learner knows that it has ended.
    ended: bool,
}

impl LocalEvaluators {
    /// Prepares `count` evaluators, which share `cores` cores. Does not start them.
    ///
    /// # Errors
    /// There is no program `evaluator` beside this program, nor on the PATH.
    pub fn new(count: usize, cores: usize) -> anyhow::Result<Self> {
        if count == 0 {
            return Ok(Self::default());
        }
        let beside = std::env::current_exe().ok().map(|own| own.with_file_name(EVALUATOR)).filter(|path| path.exists());
        let program = beside.unwrap_or_else(|| EVALUATOR.into());
        match Command::new(&program).arg("--version").output() {
            Ok(output) if output.status.success() => {}
            Ok(output) => {
                let (program, status, said) =
                    (program.display(), output.status, String::from_utf8_lossy(&output.stderr));
                return Err(anyhow!("{program} cannot be started ({status}): {}", said.trim()))
                    .hint("if it lacks libmujoco: deploy/setup.sh installs that");
            }
            Err(error) => {
                let hint = "build it with `cargo build --release --package quad-evaluator`, or leave --evaluators out and start \
                            some by hand";
                return Err(error)
                    .context("there is no program `evaluator` beside the learner or on the PATH")
                    .hint(hint);
            }
        }
        Ok(Self { count, cores, program, started: Vec::new() })
    }

    /// Starts the evaluators. They connect to the first of these endpoints, and write their logs into a folder.
    ///
    /// Call it on a thread that lives as long as the learner: the system ends the evaluators with that thread.
    ///
    /// # Errors
    /// A process or its log file cannot be made.
    pub fn start(&mut self, reachable_at: &[String], folder: &Path) -> anyhow::Result<()> {
        for number in 1..=self.count {
            let log = folder.join(format!("evaluator-{number}.log"));
            let started = spawn_logged(&mut self.command(reachable_at, number), &log);
            let process =
                started.with_context(|| format!("cannot start an evaluator that logs to {}", log.display()))?;
            self.started.push(Started { process, log, ended: false });
        }
        Ok(())
    }

    fn command(&self, reachable_at: &[String], number: usize) -> Command {
        let mut command = Command::new(&self.program);
        command.args(["serve", "--name", &format!("{EVALUATOR}-{number}"), "--connect"]).args(reachable_at.first());
        if let Some(endpoint) = reachable_at.first() {
            not_encrypted(&mut command, endpoint);
        }
        if std::env::var_os("RAYON_NUM_THREADS").is_none() {
            command.env("RAYON_NUM_THREADS", self.cores.div_ceil(self.count).to_string());
        }
        command
    }

    /// Log lines about evaluators that have ended by themselves.
    pub fn news(&mut self) -> Vec<String> {
        let ended = |started: &mut Started| {
            let status = started.process.try_wait().ok().flatten().filter(|_| !started.ended)?;
            started.ended = true;
            Some(format!("an evaluator has ended ({status}); its log is {}", started.log.display()))
        };
        self.started.iter_mut().filter_map(ended).collect()
    }

    /// Tells the evaluators to leave, and waits until they have.
    pub async fn end(&mut self) {
        let until = Instant::now() + LEAVE;
        for started in self.started.iter_mut().filter(|started| !started.ended) {
            kill_process(Pid::from_child(&started.process), Signal::TERM).ok();
        }
        for Started { process, .. } in &mut self.started {
            while let Ok(None) = process.try_wait() {
                if Instant::now() >= until {
                    process.kill().ok();
                    process.wait().ok();
                    break;
                }
                tokio::time::sleep(GLANCE).await;
            }
        }
    }
}
