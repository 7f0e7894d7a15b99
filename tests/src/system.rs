//! A scratch folder with a tiny dataset, and learners and evaluators that use it.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use tempfile::TempDir;

use crate::learner::Learner;
use crate::process::{Process, built};
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
        let folder = tempfile::tempdir().expect("there is room for a scratch folder");
        let dataset = folder.path().join("tiny.hdf5");
        fs::write(dataset, &*DATASET).expect("the scratch folder is writable");
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

    /// Starts a learner behind a command line prefix such as `env`. `run` is a path, which may be
    /// below this folder.
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
        let words = [launcher, &[built("learner").display().to_string()]].concat();
        let mut command = Command::new(&words[0]);
        command.args(&words[1..]).arg("train");
        command.arg("--preset").arg(self.preset(name_of(run_dir), setting));
        command.arg("--dataset").arg(self.dataset()).arg("--run-dir").arg(run_dir);
        command
    }

    pub fn evaluator(&self, name: &str, endpoint: &str) -> Process {
        self.evaluator_with(name, &["--connect", endpoint, "--http", "127.0.0.1:0"])
    }

    pub fn evaluator_with(&self, name: &str, arguments: &[&str]) -> Process {
        let mut command = Command::new(built("evaluator"));
        command.args(["serve", "--name", name]).args(arguments);
        Process::start(name, self.path(), command)
    }
}

fn name_of(run_dir: &Path) -> &str {
    run_dir.file_name().and_then(|name| name.to_str()).expect("a run has a name")
}

/// Made once, and copied: a program that another test starts meanwhile would keep HDF5's lock of
/// the file that is being written.
static DATASET: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let file = tempfile::NamedTempFile::new().expect("there is room for a dataset");
    write_hopper(file.path(), 10, 300);
    fs::read(file.path()).expect("it was written")
});
