//! Programs under test.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::Duration;

use crate::eventually;

/// Path of a file that cargo built.
pub fn built(path: &str) -> PathBuf {
    let test = std::env::current_exe().expect("a test knows its own executable");
    // target/release/deps/test-123 → target/release/name
    test.parent().and_then(Path::parent).expect("a test lies two folders below target/").join(path)
}

pub fn binary(name: &str) -> PathBuf {
    let path = built(name);
    assert!(path.exists(), "{path:?} is missing; cargo build --release --bins makes it");
    path
}

/// Command line prefix that preloads an example of this crate.
pub fn preload(example: &str) -> Vec<String> {
    let library = built(&format!("examples/lib{example}.so"));
    assert!(library.exists(), "{library:?} is missing; cargo build --release --examples makes it");
    vec!["env".to_owned(), format!("LD_PRELOAD={}", library.display())]
}

/// One of our programs with its arguments, none of which has a space in it.
pub fn command(line: &str) -> Command {
    let mut words = line.split_whitespace();
    let mut command = Command::new(binary(words.next().expect("a program")));
    command.args(words);
    command
}

/// Runs a command line, which must succeed; gives what it printed to stdout.
pub fn succeeds(line: &str) -> String {
    stdout(&command(line).output().expect("it starts"))
}

/// The stdout of a program that has succeeded.
pub fn stdout(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{text}{}", String::from_utf8_lossy(&output.stderr));
    text
}

/// Asserts exit code 1, and `sentence` in the error and `hint` in its hint.
pub fn assert_refused(output: &Output, sentence: &str, hint: &str) {
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{sentence}: {text}");
    let advice = text.split_once("hint: ").map(|(_, advice)| advice).unwrap_or_default();
    assert!(text.contains(sentence), "`{sentence}` is not in\n{text}");
    assert!(advice.contains(hint), "`{hint}` is not in the hint of\n{text}");
}

/// Sends a signal by its name, e.g. `TERM` or `KILL`, to a process.
pub fn signal(signal: &str, process: u32) {
    // The shell's own `kill`: a slim Debian has no program of that name.
    let command = format!("kill -{signal} {process}");
    let status = Command::new("sh").args(["-c", &command]).status().expect("there is a shell");
    assert!(status.success(), "{command}: {status}");
}

/// The processes that a process has started.
pub fn children(of: u32) -> Vec<u32> {
    let list = fs::read_to_string(format!("/proc/{of}/task/{of}/children")).unwrap_or_default();
    list.split_whitespace().map(|id| id.parse().unwrap()).collect()
}

/// A running program, killed when dropped. A failing test prints the ends of its output.
pub struct Process {
    name: String,
    child: Child,
    log: PathBuf,
    out: PathBuf,
}

impl Process {
    /// Starts `command` with its output in `folder`, in files called after `name`.
    pub fn start(name: &str, folder: &Path, mut command: Command) -> Process {
        let (log, out) = (folder.join(format!("{name}.log")), folder.join(format!("{name}.out")));
        let file = |path: &Path| File::create(path).expect("the scratch folder is writable");
        command.stdin(Stdio::null()).stdout(file(&out)).stderr(file(&log));
        let child =
            command.spawn().unwrap_or_else(|error| panic!("cannot start {command:?}: {error}"));
        Process { name: name.to_owned(), child, log, out }
    }

    pub fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap_or_default()
    }

    pub fn out(&self) -> String {
        fs::read_to_string(&self.out).unwrap_or_default()
    }

    /// Waits for a line in its log that contains `text`, and gives the line.
    pub fn wait_for_log(&self, text: &str, patience: Duration) -> String {
        let what = format!("{:?} in the log of {}", text, self.name);
        eventually(&what, patience, || {
            self.log().lines().find(|line| line.contains(text)).map(str::to_owned)
        })
    }

    /// Asserts that its log has `text`.
    pub fn assert_said(&self, text: &str) {
        let log = self.log();
        assert!(log.contains(text), "`{text}` is not in the log of {}:\n{log}", self.name);
    }

    /// Asserts that its log does not have `text`.
    pub fn assert_not_said(&self, text: &str) {
        let log = self.log();
        assert!(!log.contains(text), "`{text}` is in the log of {}:\n{log}", self.name);
    }

    /// Waits for its end with this exit code.
    pub fn assert_ends(&mut self, code: i32, patience: Duration) {
        let status = self.wait(patience);
        assert_eq!(status.code(), Some(code), "{} ended with {status}:\n{}", self.name, self.log());
    }

    pub fn signal(&self, signal: &str) {
        self::signal(signal, self.id());
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The most memory that it has had, bytes; nothing if it has ended.
    pub fn peak_memory(&self) -> Option<u64> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
        let kilobytes =
            line.trim().trim_end_matches(" kB").parse::<u64>().expect("a number of kilobytes");
        Some(kilobytes << 10)
    }

    pub fn kill(&mut self) {
        self.child.kill().expect("a child can be killed");
        self.child.wait().expect("a child can be waited for");
    }

    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().expect("a child can be waited for").is_none()
    }

    pub fn wait(&mut self, patience: Duration) -> ExitStatus {
        let what = format!("{} ended", self.name);
        eventually(&what, patience, || self.child.try_wait().expect("a child can be waited for"))
    }

    pub fn assert_succeeds(&mut self, patience: Duration) {
        let status = self.wait(patience);
        assert!(status.success(), "{} ended with {status}", self.name);
    }

    /// Sends SIGTERM and waits for the end, which a program's own time limit may bring about.
    pub fn terminate(&mut self, patience: Duration) -> ExitStatus {
        self.signal("TERM");
        self.wait(patience)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
        if std::thread::panicking() {
            for (kind, text) in [("stderr", self.log()), ("stdout", self.out())] {
                let lines: Vec<_> = text.lines().collect();
                let end = lines[lines.len().saturating_sub(40)..].join("\n");
                eprintln!("--- the end of {}'s {kind}\n{end}", self.name);
            }
        }
    }
}
