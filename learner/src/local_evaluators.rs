//! Evaluators that the learner or a sweep starts itself, and that end with it: `--evaluators N`.

use std::io;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use quad_protocol::Name;
use quad_run::files;
use quad_runtime::{Hint, threads_asked};
use rustix::process::{Pid, Signal, kill_process, set_parent_process_death_signal};

/// The program.
const EVALUATOR: &str = "evaluator";
/// An evaluator delivers its scores and leaves within two seconds; the learner kills it after this
/// time.
const LEAVE: Duration = Duration::from_secs(4);
const GLANCE: Duration = Duration::from_millis(20);
/// First and longest pause before an evaluator that has ended is started again.
const PAUSE: [Duration; 2] = [Duration::from_secs(1), Duration::from_secs(300)];

/// Sets up a command so that its process ends with the thread that starts it, and appends all its
/// output to a file. The process does not get a terminal's Ctrl-C; its parent tells it to leave.
pub(crate) fn run_beside(command: &mut Command, log: &Path) -> io::Result<()> {
    let file = files::append(log)?;
    command.stdin(Stdio::null()).stdout(file.try_clone()?).stderr(file).process_group(0);
    // SAFETY: the new process makes one system call, which may be made between fork and exec.
    #[allow(unsafe_code)]
    unsafe {
        command.pre_exec(|| Ok(set_parent_process_death_signal(Some(Signal::TERM))?));
    }
    Ok(())
}

/// Hides the user's certificates from a program that connects to an endpoint without encryption,
/// which would refuse them.
pub(crate) fn not_encrypted(command: &mut Command, endpoint: &str) {
    if endpoint.starts_with("tcp/") {
        command.env_remove("QUAD_CERTIFICATES");
    }
}

/// The evaluators to start, and those that run.
#[derive(Default)]
pub(crate) struct LocalEvaluators {
    count: usize,
    /// Cores for all evaluators together.
    cores: usize,
    program: PathBuf,
    places: Vec<Place>,
}

/// An evaluator, or the one that is to be started next in its place.
struct Place {
    command: Command,
    log: PathBuf,
    process: Option<Child>,
    /// When the process was started, or when it has ended.
    since: Instant,
    /// Time from the end of a process to the start of the next one.
    pause: Duration,
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
        let beside = std::env::current_exe()
            .ok()
            .map(|own| own.with_file_name(EVALUATOR))
            .filter(|path| path.exists());
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
                let hint = "build it with `cargo build --release --package quad-evaluator`, or start some by hand and give \
                            --evaluators 0";
                return Err(error)
                    .context("there is no program `evaluator` beside the learner or on the PATH")
                    .hint(hint);
            }
        }
        Ok(Self { count, cores, program, places: Vec::new() })
    }

    /// Starts the evaluators. They connect to the first of these endpoints, write their logs into a
    /// folder, and are called after `owner`, the run or study: several learners may meet at one
    /// router.
    ///
    /// Call this and [`news`](Self::news) on a thread that lives as long as the learner: the system
    /// ends the evaluators with that thread.
    ///
    /// # Errors
    /// A process or its log file cannot be made.
    pub fn start(
        &mut self,
        reachable_at: &[String],
        folder: &Path,
        owner: &str,
    ) -> anyhow::Result<()> {
        for number in 1..=self.count {
            let log = folder.join(format!("{EVALUATOR}-{number}.log"));
            let mut command =
                self.command(reachable_at, Name::new(format!("{owner}-{EVALUATOR}-{number}")).ok());
            let started = run_beside(&mut command, &log).and_then(|()| command.spawn());
            let process = started.with_context(|| {
                format!("cannot start an evaluator that logs to {}", log.display())
            })?;
            let (process, since) = (Some(process), Instant::now());
            self.places.push(Place { command, log, process, since, pause: Duration::ZERO });
        }
        Ok(())
    }

    /// The command of an evaluator. Without a name, as where that would be too long, it chooses one
    /// that no other has.
    fn command(&self, reachable_at: &[String], name: Option<Name>) -> Command {
        let mut command = Command::new(&self.program);
        command.arg("serve");
        if let Some(name) = name {
            command.args(["--name", name.as_str()]);
        }
        if let Some(endpoint) = reachable_at.first() {
            command.args(["--connect", endpoint]);
            not_encrypted(&mut command, endpoint);
        }
        if threads_asked().is_none() {
            command.env("RAYON_NUM_THREADS", self.cores.div_ceil(self.count).to_string());
        }
        command
    }

    /// The log of the first, if there is one.
    pub fn log(&self) -> Option<&Path> {
        self.places.first().map(|place| place.log.as_path())
    }

    /// Starts others in place of evaluators that have ended by themselves, and returns log lines
    /// about them.
    pub fn news(&mut self) -> Vec<String> {
        self.places.iter_mut().filter_map(|place| place.look(Instant::now())).collect()
    }

    /// Tells the evaluators to leave, and waits until they have.
    pub async fn end(&mut self) {
        let until = Instant::now() + LEAVE;
        let mut processes: Vec<Child> =
            self.places.drain(..).filter_map(|place| place.process).collect();
        for process in &processes {
            kill_process(Pid::from_child(process), Signal::TERM).ok();
        }
        for process in &mut processes {
            while let Ok(None) = process.try_wait() {
                if Instant::now() >= until {
                    process.kill().ok();
                    break;
                }
                tokio::time::sleep(GLANCE).await;
            }
        }
    }
}

impl Place {
    /// Starts the next evaluator when it is time. One that ends again and again is started less and
    /// less often. Returns what there is to say.
    fn look(&mut self, now: Instant) -> Option<String> {
        let lasted = now.saturating_duration_since(self.since);
        let end = match &mut self.process {
            Some(process) => match process.try_wait() {
                Ok(None) => return None,
                Ok(Some(status)) => format!("has ended ({status})"),
                Err(error) => format!("is lost ({error})"),
            },
            None if lasted < self.pause => return None,
            None => match self.command.spawn() {
                Ok(process) => {
                    (self.process, self.since) = (Some(process), now);
                    return None;
                }
                Err(error) => format!("cannot be started ({error})"),
            },
        };
        let has_worked = self.process.take().is_some() && lasted >= PAUSE[1];
        self.pause = if has_worked { PAUSE[0] } else { (2 * self.pause).clamp(PAUSE[0], PAUSE[1]) };
        self.since = now;
        let (seconds, log) = (self.pause.as_secs(), self.log.display());
        Some(format!(
            "an evaluator {end}; another takes its place in {seconds} s; their log is {log}"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder of a study may be another user's.
    #[test]
    fn a_log_is_no_link_and_no_pipe() {
        let folder = tempfile::tempdir().unwrap();
        let [precious, link, pipe] =
            ["precious", "link", "pipe"].map(|name| folder.path().join(name));
        std::fs::write(&precious, "precious").unwrap();
        std::os::unix::fs::symlink(&precious, &link).unwrap();
        assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let (tell, told) = std::sync::mpsc::channel();
        std::thread::spawn(move || {
            let logged = |log: &Path| run_beside(&mut Command::new("true"), log).is_ok();
            tell.send([&link, &pipe, &precious].map(|log| logged(log)))
        });
        let logged = told.recv_timeout(Duration::from_secs(60)).expect("it waits for a pipe");
        assert_eq!(logged, [false, false, true]);
    }

    #[test]
    fn one_that_ends_again_and_again_is_started_less_and_less_often() {
        let (mut now, log) = (Instant::now(), PathBuf::from("log"));
        let mut place = Place {
            command: Command::new("false"),
            log,
            process: None,
            since: now,
            pause: Duration::ZERO,
        };
        let mut pauses = Vec::new();
        for _ in 0..10 {
            assert_eq!(place.look(now), None, "it is started");
            while place.look(now).is_none() {
                std::thread::sleep(GLANCE);
            }
            pauses.push(place.pause.as_secs());
            assert!(
                place.look(now + place.pause - GLANCE).is_none() && place.process.is_none(),
                "that is too soon"
            );
            now += place.pause;
        }
        assert_eq!(pauses, [1, 2, 4, 8, 16, 32, 64, 128, 256, 300]);
        place.look(now);
        while place.look(now + PAUSE[1]).is_none() {
            std::thread::sleep(GLANCE);
        }
        assert_eq!(place.pause, PAUSE[0], "one that has worked for long is started at once");
    }
}
