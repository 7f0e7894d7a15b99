//! A scratch folder with a tiny dataset, and learners and evaluators that use it.

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::LazyLock;

use quad_dataset::{D4rlWriter, Metadata, Row, environment};
use tempfile::TempDir;

use crate::PATIENCE;
use crate::learner::Learner;
use crate::process::{Process, binary};
use crate::setting::Setting;

/// A folder that goes when the test is over.
pub struct Scratch {
    folder: TempDir,
}

#[allow(clippy::new_without_default)]
impl Scratch {
    /// Makes it, with a dataset of a few thousand made-up transitions.
    pub fn new() -> Scratch {
        Self::inside(&std::env::temp_dir())
    }

    /// Makes the folder inside of another.
    pub fn inside(parent: &Path) -> Scratch {
        let folder = tempfile::tempdir_in(parent).expect("there is room for a scratch folder");
        fs::write(folder.path().join("tiny.hdf5"), &*DATASET).expect("the scratch folder is writable");
        Scratch { folder }
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// The dataset.
    pub fn dataset(&self) -> PathBuf {
        self.path().join("tiny.hdf5")
    }

    /// Writes a preset of that name.
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

    /// Starts a learner by a command line of which its own is the end, as `ip netns exec` and `env` have it. `run` may be a
    /// path below this folder.
    pub fn learner_through(&self, launcher: &[String], run: &str, setting: Setting, arguments: &[&str]) -> Learner {
        let run_dir = self.path().join(run);
        let name = run_dir.file_name().and_then(|name| name.to_str()).expect("a run has a name");
        let preset = self.preset(name, setting);
        fs::remove_file(run_dir.join("endpoints.json")).ok();
        let mut command = through(launcher, "learner");
        command.arg("train").arg("--preset").arg(preset).arg("--dataset").arg(self.dataset());
        command.arg("--run-dir").arg(&run_dir).args(arguments);
        if !arguments.contains(&"--http") {
            command.args(["--http", "127.0.0.1:0"]);
        }
        let process = Process::start(name, self.path(), command);
        Learner { process, run_dir }
    }

    /// Starts an evaluator that is called `name`.
    pub fn evaluator(&self, name: &str, endpoint: &str) -> Evaluator {
        self.evaluator_with(name, &["--connect", endpoint, "--http", "127.0.0.1:0"])
    }

    /// Starts an evaluator that is called `name`, with further arguments.
    pub fn evaluator_with(&self, name: &str, arguments: &[&str]) -> Evaluator {
        self.evaluator_through(&[], name, arguments)
    }

    /// Starts an evaluator by a command line of which its own is the end.
    pub fn evaluator_through(&self, launcher: &[String], name: &str, arguments: &[&str]) -> Evaluator {
        let mut command = through(launcher, "evaluator");
        command.args(["serve", "--name", name]).args(arguments);
        Evaluator { process: Process::start(name, self.path(), command) }
    }
}

fn through(launcher: &[String], program: &str) -> Command {
    let Some((first, rest)) = launcher.split_first() else { return Command::new(binary(program)) };
    let mut command = Command::new(first);
    command.args(rest).arg(binary(program));
    command
}

/// An evaluator.
pub struct Evaluator {
    /// The process.
    pub process: Process,
}

impl Evaluator {
    /// Address of its metrics page, which it logs.
    pub fn metrics(&self) -> String {
        let line = self.process.wait_for_log("/metrics", PATIENCE);
        let address = line.split_once("http://").and_then(|(_, rest)| rest.split_once("/metrics"));
        address.expect("the log line has the page's address").0.to_owned()
    }
}

/// A port that was free a moment ago, where it must be known before its owner starts.
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("the system has free ports");
    listener.local_addr().expect("a bound socket has an address").port()
}

/// A TCP endpoint at such a port.
pub fn free_endpoint() -> String {
    format!("tcp/127.0.0.1:{}", free_port())
}

/// Made once, and copied: a program that another test starts meanwhile would keep HDF5's lock of the file that is being written.
static DATASET: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let file = tempfile::NamedTempFile::new().expect("there is room for a dataset");
    write_dataset(file.path());
    fs::read(file.path()).expect("it was written")
});

/// Ten episodes of three hundred steps: smooth, bounded, of different returns, and far from any physics.
fn write_dataset(path: &Path) {
    let spec = environment::find("hopper").expect("hopper is known");
    let mut writer = D4rlWriter::create(path, spec).expect("the scratch folder is writable");
    let [qpos, qvel] = [vec![0.0; spec.qpos_dim], vec![0.0; spec.qvel_dim]];
    for (episode, step) in (0..10).flat_map(|episode| (0..300).map(move |step| (episode, step))) {
        let wave = |at: usize, i: usize| ((episode * 7 + at + 3 * i) as f64 * 0.1).sin();
        let [now, next] = [step, step + 1].map(|at| Vec::from_iter((0..spec.observation_dim).map(|i| wave(at, i))));
        let action = Vec::from_iter((0..spec.action_dim).map(|i| 0.9 * ((episode + 2 * step + i) as f64).cos()));
        let row = Row {
            observation: &now,
            action: &action,
            next_observation: &next,
            reward: 1.0 + 0.1 * episode as f64 + action[0],
            terminal: false,
            timeout: step == 299,
            qpos: &qpos,
            qvel: &qvel,
        };
        writer.push(&row).expect("the row has the environment's sizes");
    }
    let metadata = Metadata { algorithm: "made up", iteration: 0, seed: 0 };
    writer.finish(&metadata).expect("the scratch folder is writable");
}
