//! Programs under test.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Output, Stdio};

use crate::eventually;

/// Path of a program, or another file, that cargo built.
pub fn built(path: &str) -> PathBuf {
    let test = std::env::current_exe().expect("a test knows its own executable");
    // target/release/deps/test-123 → target/release/name
    let folder = test.parent().and_then(Path::parent).expect("a test lies below target/");
    let path = folder.join(path);
    assert!(path.exists(), "{path:?} is missing; cargo build --release --bins --examples makes it");
    path
}

/// Command line prefix that preloads an example of this crate.
pub fn preload(example: &str) -> Vec<String> {
    let library = built(&format!("examples/lib{example}.so"));
    vec!["env".to_owned(), format!("LD_PRELOAD={}", library.display())]
}

/// One of our programs with its arguments, none of which has a space in it.
pub fn command(line: &str) -> Command {
    let mut words = line.split_whitespace();
    let mut command = Command::new(built(words.next().expect("a program")));
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

/// Asserts exit code 1, `sentence` in the error, and `hint` in its hint.
pub fn assert_refused(output: &Output, sentence: &str, hint: &str) {
    let text = String::from_utf8_lossy(&output.stderr);
    let (error, advice) = text.split_once("hint: ").unwrap_or((&text, ""));
    let is_told = error.contains(sentence) && advice.contains(hint);
    assert!(output.status.code() == Some(1) && is_told, "not {sentence:?}, hint {hint:?}: {text}");
}

/// Sends a signal by its name, e.g. `TERM` or `KILL`, to a process.
pub fn signal(signal: &str, process: u32) {
    // The shell's own `kill`: a slim Debian has no program of that name.
    let command = format!("kill -{signal} {process}");
    let status = Command::new("sh").args(["-c", &command]).status().expect("there is a shell");
    assert!(status.success(), "{command}: {status}");
}

/// The processes that a process has started.
pub fn children(parent: u32) -> Vec<u32> {
    let list = fs::read_to_string(format!("/proc/{parent}/task/{parent}/children"));
    list.unwrap_or_default().split_whitespace().map(|id| id.parse().unwrap()).collect()
}

/// A running program, killed when dropped. A failing test prints the end of its output.
pub struct Process {
    name: String,
    child: Child,
    log: PathBuf,
}

impl Process {
    /// Starts `command` with all its output in `folder`, in a file called after `name`.
    pub fn start(name: &str, folder: &Path, mut command: Command) -> Process {
        let log = folder.join(format!("{name}.log"));
        let file = File::create(&log).expect("the scratch folder is writable");
        command.stdin(Stdio::null()).stdout(file.try_clone().unwrap()).stderr(file);
        let child = command.spawn();
        let child = child.unwrap_or_else(|error| panic!("cannot start {command:?}: {error}"));
        Process { name: name.to_owned(), child, log }
    }

    pub fn log(&self) -> String {
        fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Waits for a line in its log that contains `text`, and gives the line.
    pub fn wait_for_log(&self, text: &str) -> String {
        eventually(&format!("{text:?} in the log of {}", self.name), || {
            self.log().lines().find(|line| line.contains(text)).map(str::to_owned)
        })
    }

    /// The address `host:port` that a line of its log has before `end`.
    pub fn wait_for_address(&self, end: &str) -> String {
        let line = self.wait_for_log(end);
        let (before, _) = line.split_once(end).expect("the line has it");
        let start = before.rfind(['/', ' ', '=', '"']).map_or(0, |place| place + 1);
        before[start..].to_owned()
    }

    pub fn assert_said(&self, text: &str) {
        assert!(self.log().contains(text), "{} did not say {text:?}", self.name);
    }

    pub fn assert_not_said(&self, text: &str) {
        assert!(!self.log().contains(text), "{} said {text:?}", self.name);
    }

    pub fn signal(&self, signal: &str) {
        self::signal(signal, self.id());
    }

    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// The most memory that it has had, bytes.
    pub fn peak_memory(&self) -> u64 {
        let status = fs::read_to_string(format!("/proc/{}/status", self.id())).unwrap();
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let kilobytes = line.expect("it runs").trim().trim_end_matches(" kB");
        kilobytes.parse::<u64>().unwrap() << 10
    }

    pub fn kill(&mut self) {
        self.child.kill().expect("a child can be killed");
        self.child.wait().expect("a child can be waited for");
    }

    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    pub fn wait(&mut self) -> ExitStatus {
        eventually(&format!("{} ended", self.name), || {
            self.child.try_wait().expect("a child can be waited for")
        })
    }

    /// Waits for its end with this exit code.
    pub fn assert_ends(&mut self, code: i32) {
        let status = self.wait();
        assert_eq!(status.code(), Some(code), "{} ended with {status}", self.name);
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
        if std::thread::panicking() {
            let log = self.log();
            let lines = Vec::from_iter(log.lines());
            let end = lines[lines.len().saturating_sub(40)..].join("\n");
            eprintln!("--- the end of what {} said\n{end}", self.name);
        }
    }
}
