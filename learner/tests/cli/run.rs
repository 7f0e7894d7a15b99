//! Run folders as learners write them.

use std::fs;
use std::path::Path;

use serde_json::{Value, json};
use toml::Table;

use crate::printed;

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
        let mut experiment: Table =
            printed(&["presets", task, "--algorithm", algorithm]).parse().unwrap();
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
        let mut config = toml::toml! { run = {} };
        config.extend(
            [("run", run), ("dataset", dataset), ("experiment", experiment)]
                .map(|(k, t)| (k.into(), t.into())),
        );
        config["run"].as_table_mut().unwrap().insert("preset".into(), task.into());
        Self { config, scores: Vec::new() }
    }

    /// Changes values by their dotted keys.
    pub fn set(mut self, changes: &[(&str, toml::Value)]) -> Self {
        for (key, value) in changes {
            let (tables, key) = key.rsplit_once('.').unwrap();
            let table = tables
                .split('.')
                .fold(&mut self.config, |table, key| table[key].as_table_mut().unwrap());
            table.insert((*key).to_owned(), value.clone());
        }
        self
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

    pub fn write(&self, path: &Path) {
        fs::create_dir_all(path.join("snapshots")).unwrap();
        fs::write(path.join("config.toml"), self.config.to_string()).unwrap();
        let lines = self.scores.iter().map(|line| format!("{line}\n"));
        fs::write(path.join("scores.jsonl"), lines.collect::<String>()).unwrap();
    }
}
