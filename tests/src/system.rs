//! A scratch folder with a tiny dataset, and learners and evaluators that use it.

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU16, Ordering::Relaxed};

use tempfile::TempDir;

use crate::PATIENCE;
use crate::learner::Learner;
use crate::process::{Process, binary};
use crate::setting::Setting;

#[path = "../fixtures/hopper.rs"]
mod hopper;
use hopper::write_hopper;

pub struct Scratch {
    folder: TempDir,
}

#[allow(clippy::new_without_default)]
impl Scratch {
    /// Makes it, with a dataset of 2,990 made-up transitions.
    pub fn new() -> Scratch {
        Self::inside(&std::env::temp_dir())
    }

    pub fn inside(parent: &Path) -> Scratch {
        let folder = tempfile::tempdir_in(parent).expect("there is room for a scratch folder");
        fs::write(folder.path().join("tiny.hdf5"), &*DATASET)
            .expect("the scratch folder is writable");
        Scratch { folder }
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    pub fn dataset(&self) -> PathBuf {
        self.path().join("tiny.hdf5")
    }

    pub fn preset(&self, name: &str, setting: Setting) -> PathBuf {
        let preset = self.path().join(format!("{name}.toml"));
        fs::write(&preset, setting.to_toml()).expect("the scratch folder is writable");
        preset
    }

    /// Starts a learner on a port that the system chooses.
    pub fn learner(&self, run: &str, setting: Setting) -> Learner {
        self.learner_with(run, setting, &["--listen", "tcp/127.0.0.1:0"])
    }

    /// Starts a learner with further arguments, among them where it listens or connects.
    pub fn learner_with(&self, run: &str, setting: Setting, arguments: &[&str]) -> Learner {
        self.learner_through(&[], run, setting, arguments)
    }

    /// Starts a learner behind a command line prefix such as `env`. `run` may be a path below this
    /// folder.
    pub fn learner_through(
        &self,
        launcher: &[String],
        run: &str,
        setting: Setting,
        arguments: &[&str],
    ) -> Learner {
        let run_dir = self.path().join(run);
        fs::remove_file(run_dir.join("endpoints.json")).ok();
        let mut command = self.train(launcher, &run_dir, setting);
        command.args(arguments);
        let process = Process::start(name_of(&run_dir), self.path(), command);
        Learner { process, run_dir }
    }

    /// The command that trains a run on the dataset.
    pub fn train(&self, launcher: &[String], run_dir: &Path, setting: Setting) -> Command {
        let mut command = through(launcher, "learner");
        command.arg("train").arg("--preset").arg(self.preset(name_of(run_dir), setting));
        command.arg("--dataset").arg(self.dataset()).arg("--run-dir").arg(run_dir);
        command
    }

    pub fn evaluator(&self, name: &str, endpoint: &str) -> Evaluator {
        self.evaluator_with(name, &["--connect", endpoint, "--http", "127.0.0.1:0"])
    }

    pub fn evaluator_with(&self, name: &str, arguments: &[&str]) -> Evaluator {
        self.evaluator_through(&[], name, arguments)
    }

    pub fn evaluator_through(
        &self,
        launcher: &[String],
        name: &str,
        arguments: &[&str],
    ) -> Evaluator {
        let mut command = through(launcher, "evaluator");
        command.args(["serve", "--name", name]).args(arguments);
        Evaluator { process: Process::start(name, self.path(), command) }
    }
}

fn name_of(run_dir: &Path) -> &str {
    run_dir.file_name().and_then(|name| name.to_str()).expect("a run has a name")
}

fn through(launcher: &[String], program: &str) -> Command {
    let Some((first, rest)) = launcher.split_first() else { return Command::new(binary(program)) };
    let mut command = Command::new(first);
    command.args(rest).arg(binary(program));
    command
}

pub struct Evaluator {
    pub process: Process,
}

impl Evaluator {
    /// Address of the metrics page, from the log.
    pub fn metrics(&self) -> String {
        let line = self.process.wait_for_log("/metrics", PATIENCE);
        let address = line.split_once("http://").and_then(|(_, rest)| rest.split_once("/metrics"));
        address.expect("the log line has the page's address").0.to_owned()
    }
}

/// A free port, where it must be known before its owner starts, or between two owners. It stays
/// free: the system itself gives ports from 32,768 on to those who want any, or who connect, and of
/// a hundred others a test's process has the first as long as it runs.
pub fn free_port() -> u16 {
    static FIRST: LazyLock<(u16, TcpListener)> = LazyLock::new(|| {
        let mut hundreds = (0..100).map(|n| 20_000 + (std::process::id() + n) as u16 % 100 * 100);
        let listen = |first| Some((first, TcpListener::bind(("127.0.0.1", first)).ok()?));
        hundreds.find_map(listen).expect("fewer than a hundred tests run at once")
    });
    static NEXT: AtomicU16 = AtomicU16::new(0);
    loop {
        let port = FIRST.0 + 1 + NEXT.fetch_add(1, Relaxed) % 99;
        if TcpListener::bind(("127.0.0.1", port)).is_ok() {
            return port;
        }
    }
}

pub fn free_endpoint() -> String {
    format!("tcp/127.0.0.1:{}", free_port())
}

/// Made once, and copied: a program that another test starts meanwhile would keep HDF5's lock of
/// the file that is being written.
static DATASET: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let file = tempfile::NamedTempFile::new().expect("there is room for a dataset");
    write_hopper(file.path(), 10, 300);
    fs::read(file.path()).expect("it was written")
});
