//! Run folders as learners write them.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use toml::Table;

use crate::printed;

pub const HOPPER: &str = "hopper-medium-replay-v2";
pub const TASKS: [&str; 2] = ["hopper-demo", "walker2d-demo"];

/// A run whose files can be changed before they are written.
#[derive(Clone)]
pub struct Run {
    /// The run's `config.toml`, as a learner wrote it that had presets in place of tasks, and no
    /// choice of the device.
    pub config: Table,
    /// The lines of its `scores.jsonl`.
    pub scores: Vec<Value>,
}

impl Run {
    /// Makes a run by QUAD.
    pub fn new(task: &str, seed: u64) -> Self {
        Self::by("quad", task, seed)
    }

    /// Makes a run by another algorithm.
    pub fn by(algorithm: &str, task: &str, seed: u64) -> Self {
        let preset = printed(&format!("presets {task} --algorithm {algorithm}"));
        let mut experiment: Table = preset.parse().unwrap();
        experiment.insert("seed".into(), (seed as i64).into());
        let run = toml::toml! { name = "r" incarnation = 1 version = "0" };
        let dataset = toml::toml! {
            path = "data.hdf5"
            transitions = 100
            episodes = 3
            min_return = 10.0
            mean_return = 20.0
            max_return = 30.0
            mean_score = 10.7
        };
        let mut config = Table::new();
        for (name, table) in [("run", run), ("dataset", dataset), ("experiment", experiment)] {
            config.insert(name.to_owned(), table.into());
        }
        let scores = Vec::new();
        Self { config, scores }.set("run.preset", task)
    }

    /// Changes a value by its dotted key.
    pub fn set(mut self, key: &str, value: impl Into<toml::Value>) -> Self {
        let (tables, key) = key.rsplit_once('.').unwrap();
        let mut table = &mut self.config;
        for key in tables.split('.') {
            table = table[key].as_table_mut().unwrap();
        }
        table.insert(key.to_owned(), value.into());
        self
    }

    pub fn sizes(self, steps: i64, eval_interval: i64, episodes: i64) -> Self {
        self.set("experiment.steps", steps)
            .set("experiment.eval_interval", eval_interval)
            .set("experiment.episodes", episodes)
    }

    /// Scores an episode, on a CPU with AVX-512.
    pub fn score(&mut self, step: u64, seed: u64, score: f64, weights: &str) {
        self.scores.push(json!({
            "step": step,
            "seed": seed,
            "return": 10.0 * score,
            "length": 5,
            "score": score,
            "weights": weights,
            "precision": "f32-avx512",
            "evaluator": "e",
        }));
    }

    /// As of a robot without reference returns.
    pub fn scores_are_returns(mut self) -> Self {
        for line in &mut self.scores {
            line["return"] = line["score"].clone();
        }
        self
    }

    pub fn write(&self, path: impl AsRef<Path>) {
        let path = path.as_ref();
        fs::create_dir_all(path.join("snapshots")).unwrap();
        fs::write(path.join("config.toml"), self.config.to_string()).unwrap();
        let lines = self.scores.iter().map(|line| format!("{line}\n"));
        fs::write(path.join("scores.jsonl"), lines.collect::<String>()).unwrap();
    }
}

/// Writes runs into folders 0, 1, …
pub fn write_all(folder: impl AsRef<Path>, runs: impl IntoIterator<Item = Run>) {
    for (index, run) in runs.into_iter().enumerate() {
        run.write(folder.as_ref().join(index.to_string()));
    }
}

/// A run of 6,000 steps with an evaluation of two episodes every thousand: complete ones with means
/// 2, 4, 6, 8, 10 (+ shift), each ± √2, and half of a sixth.
pub fn small(seed: u64, shift: f64) -> Run {
    let mut run = Run::new("hopper-demo", seed).sizes(6000, 1000, 2);
    for n in 1..=5 {
        let mean = 2.0 * n as f64 + shift;
        run.score(1000 * n, 0, mean - 1.0, "00");
        run.score(1000 * n, 1, mean + 1.0, "00");
    }
    run.score(6000, 1, 99.0, "00");
    run
}

/// The run of [`small`] online after 3,000 steps.
pub fn online() -> Run {
    let online = toml::toml! {
        steps = 2000
        updates_per_step = 2
        warmup = 500
        uniform_warmup = false
        noise = 0.0
        lag = 2
        snapshot_interval = 1000
    };
    small(0, 0.0).set("experiment.steps", 3000).set("experiment.online", online)
}

/// The run of [`online`], but best before online learning.
pub fn fallen() -> Run {
    let mut run = online();
    run.scores[4..6].iter_mut().for_each(|line| line["score"] = json!(50.0));
    run
}

/// Four runs of one of the paper's tasks, with a score of each evaluation up to `last`.
pub fn paper(task: &str, last: u64, score: impl Fn(u64) -> f64) -> Vec<Run> {
    let run = |seed| {
        let mut run = Run::new(task, seed);
        for step in (20_000..=last).step_by(20_000) {
            (0..10).for_each(|episode| run.score(step, episode, score(step) + seed as f64, "00"));
        }
        run
    };
    (0..4).map(run).collect()
}

/// A complete run of five evaluations with two episodes each, whose score is their mean.
pub fn complete(run: Run, score: f64) -> Run {
    let mut run = run.sizes(5000, 1000, 2);
    for step in 1..=5 {
        let score = score + 2.0 * (step as f64 - 3.0);
        (0..2).for_each(|episode| run.score(1000 * step, episode, score, "00"));
    }
    run
}

/// QUAD with two temperatures, DAC and IQL on two tasks with five seeds, each run in a folder of
/// its own.
pub fn write_study(folder: &str) {
    for (task, base) in TASKS.into_iter().zip([40.0, 90.0]) {
        for (seed, noise) in [0.0, 3.0, -1.0, 2.0, -4.0].into_iter().enumerate() {
            let quad = || Run::new(task, seed as u64);
            for (name, run, score) in [
                ("1", quad().set("experiment.agent.tau", 0.1), base + noise),
                ("2", quad().set("experiment.agent.tau", 10.0), base + 10.0 + noise / 2.0),
                ("3", quad().set("experiment.agent.guidance", "dac"), base + 0.1 - noise),
                ("4", Run::by("iql", task, seed as u64), base + 15.0 + noise),
            ] {
                complete(run, score).write(format!("{folder}/{task}/{name}/{seed}"));
            }
        }
    }
}
