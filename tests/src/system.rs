//! A scratch folder with a tiny dataset and preset, and learners and evaluators that use them.

use std::fs;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;

use quad_dataset::{D4rlWriter, Metadata, Row, environment};
use quad_protocol::Hash;
use serde_json::Value;
use tempfile::TempDir;

use crate::process::{Process, binary};
use crate::{PATIENCE, eventually};

/// What a test may choose of a training run; the rest of the preset is fixed and small.
#[derive(Clone, Copy)]
pub struct Setting {
    /// Gradient steps.
    pub steps: u64,
    /// Gradient steps between two evaluations.
    pub eval_interval: u64,
    /// Episodes per evaluation.
    pub episodes: u32,
    /// N_a: what makes an evaluator's job long or short.
    pub candidates: u32,
    /// Width of the networks.
    pub hidden: u32,
    /// Seed of the run.
    pub seed: u64,
}

impl Default for Setting {
    /// Four evaluations, over within a second.
    fn default() -> Setting {
        Setting { steps: 80, eval_interval: 20, episodes: 6, candidates: 2, hidden: 16, seed: 1 }
    }
}

impl Setting {
    /// The steps that are evaluated.
    pub fn evaluated_steps(&self) -> Vec<u64> {
        (1..=self.steps).filter(|step| step % self.eval_interval == 0 || *step == self.steps).collect()
    }

    fn to_toml(self) -> String {
        let Setting { steps, eval_interval, episodes, candidates, hidden, seed } = self;
        format!(
            r#"environment = "hopper"
reward = "locomotion"
steps = {steps}
eval_interval = {eval_interval}
episodes = {episodes}
candidates = {candidates}
seed = {seed}
batch_size = 16
algorithm = "quad"

[agent]
hidden = {hidden}
critics = 2
diffusion_steps = 2
gamma = 0.99
rho = 1.0
guidance = "quad"
tau = 1.0
delta = 1e-6
samples = 1
target_reduce = "mean"
actor_learning_rate = 1e-3
critic_learning_rate = 1e-3
gradient_clip = 1.0
ema_rate = 5e-3
nu_ema_rate = 5e-3
actor_ema_every = 5
actor_ema_start = 10

[agent.eta]
initial = 1.0
rate = 1e-3
minimum = 1e-3
maximum = 100.0
"#
        )
    }
}

/// A folder that goes when the test is over.
pub struct Scratch {
    folder: TempDir,
}

impl Scratch {
    /// Makes it, with a dataset of a few thousand made-up transitions.
    pub fn new() -> Scratch {
        Self::inside(&std::env::temp_dir())
    }

    /// The same inside of that folder.
    pub fn inside(parent: &Path) -> Scratch {
        let folder = tempfile::tempdir_in(parent).expect("there is room for a scratch folder");
        let written = folder.path().join("written.hdf5");
        write_dataset(&written);
        // HDF5 locks the file it writes, and every process that another test starts meanwhile inherits the lock for as
        // long as it lives. A copy has none.
        fs::copy(&written, folder.path().join("tiny.hdf5")).expect("there is room for the dataset");
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
        // An earlier learner's in the same folder.
        fs::remove_file(run_dir.join("endpoints.json")).ok();
        let mut command = through(launcher, "learner");
        command.arg("train").arg("--preset").arg(preset).arg("--dataset").arg(self.dataset());
        command.arg("--run-dir").arg(&run_dir).args(arguments);
        if !arguments.contains(&"--metrics") {
            command.args(["--metrics", "127.0.0.1:0"]);
        }
        let process = Process::start(name, self.path(), command);
        Learner { process, run_dir }
    }

    /// Starts an evaluator that is called `name`.
    pub fn evaluator(&self, name: &str, endpoint: &str) -> Evaluator {
        self.evaluator_with(name, &["--connect", endpoint, "--metrics", "127.0.0.1:0"])
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

impl Default for Scratch {
    fn default() -> Scratch {
        Scratch::new()
    }
}

fn through(launcher: &[String], program: &str) -> Command {
    let Some((first, rest)) = launcher.split_first() else { return Command::new(binary(program)) };
    let mut command = Command::new(first);
    command.args(rest).arg(binary(program));
    command
}

/// A learner and the folder of its run.
pub struct Learner {
    /// The process.
    pub process: Process,
    /// Its run folder.
    pub run_dir: PathBuf,
}

impl Learner {
    /// The endpoint that evaluators connect to, once it listens.
    pub fn endpoint(&self) -> String {
        self.endpoints()["zenoh"][0].as_str().expect("an endpoint is text").to_owned()
    }

    /// Address of its metrics page.
    pub fn metrics(&self) -> String {
        self.endpoints()["metrics"].as_str().expect("an address is text").to_owned()
    }

    fn endpoints(&self) -> Value {
        let path = self.run_dir.join("endpoints.json");
        eventually("the learner wrote endpoints.json", PATIENCE, || serde_json::from_slice(&fs::read(&path).ok()?).ok())
    }

    /// The lines of scores.jsonl so far.
    pub fn scores(&self) -> Vec<Score> {
        let text = fs::read_to_string(self.run_dir.join("scores.jsonl")).unwrap_or_default();
        let complete = text.rfind('\n').map_or("", |end| &text[..end]);
        complete.lines().map(|line| Score(serde_json::from_str(line).expect("a line is a JSON object"))).collect()
    }

    /// Fails unless every episode of every evaluation has exactly one score, measured with the snapshot on disk.
    pub fn assert_complete(&self, setting: &Setting) {
        let scores = self.scores();
        let mut keys: Vec<_> = scores.iter().map(Score::key).collect();
        keys.sort_unstable();
        let count = keys.len();
        keys.dedup();
        assert_eq!(keys.len(), count, "a (step, seed) has two scores");
        for step in setting.evaluated_steps() {
            let of_step: Vec<_> = scores.iter().filter(|score| score.key().0 == step).collect();
            assert_eq!(of_step.len(), setting.episodes as usize, "scores of step {step}");
            let tensors = fs::read(self.snapshot(step)).expect("an evaluated snapshot is kept");
            let hash = Hash::of(&tensors).to_string();
            for score in of_step {
                assert_eq!(score.text("weights"), hash, "weights of step {step}");
            }
        }
        assert_eq!(count, setting.evaluated_steps().len() * setting.episodes as usize, "scores in all");
    }

    /// The snapshot that the learner saved after a gradient step.
    pub fn snapshot(&self, step: u64) -> PathBuf {
        self.run_dir.join(format!("snapshots/step_{step:09}.safetensors"))
    }
}

/// A line of scores.jsonl.
pub struct Score(Value);

impl Score {
    /// Gradient step and episode seed: what has to be scored exactly once.
    pub fn key(&self) -> (u64, u64) {
        (self.integer("step"), self.integer("seed"))
    }

    /// A field that is a whole number.
    pub fn integer(&self, field: &str) -> u64 {
        self.0[field].as_u64().unwrap_or_else(|| panic!("{field} is no whole number in {}", self.0))
    }

    /// A field that is a number.
    pub fn number(&self, field: &str) -> f64 {
        self.0[field].as_f64().unwrap_or_else(|| panic!("{field} is no number in {}", self.0))
    }

    /// A field that is text.
    pub fn text(&self, field: &str) -> &str {
        self.0[field].as_str().unwrap_or_else(|| panic!("{field} is no text in {}", self.0))
    }
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

/// A port that was free a moment ago, for whoever must know it before its owner starts.
pub fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("the system has free ports");
    listener.local_addr().expect("a bound socket has an address").port()
}

/// Ten episodes of three hundred steps: smooth, bounded, of different returns, and far from any physics.
fn write_dataset(path: &Path) {
    let spec = environment::find("hopper").expect("hopper is known");
    let mut writer = D4rlWriter::create(path, spec).expect("the scratch folder is writable");
    let observation = |episode: usize, step: usize| -> Vec<f64> {
        (0..spec.observation_dim).map(|i| ((episode * 7 + step + 3 * i) as f64 * 0.1).sin()).collect()
    };
    for (episode, step) in (0..10).flat_map(|episode| (0..300).map(move |step| (episode, step))) {
        let action: Vec<f64> = (0..spec.action_dim).map(|i| 0.9 * ((episode + 2 * step + i) as f64).cos()).collect();
        let row = Row {
            observation: &observation(episode, step),
            action: &action,
            next_observation: &observation(episode, step + 1),
            reward: 1.0 + 0.1 * episode as f64 + action[0],
            terminal: false,
            timeout: step == 299,
            qpos: &vec![0.0; spec.qpos_dim],
            qvel: &vec![0.0; spec.qvel_dim],
        };
        writer.push(&row).expect("the row has the environment's sizes");
    }
    let metadata = Metadata { algorithm: "made up", iteration: 0, seed: 0 };
    writer.finish(&metadata).expect("the scratch folder is writable");
}
