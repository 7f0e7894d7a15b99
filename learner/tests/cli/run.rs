//! Run folders as learners write them.

use std::fs;
use std::path::Path;

use quad_run::config::resolve;
use serde_json::json;
use toml::{Table, Value};

/// A run whose files can be changed before they are written.
#[derive(Clone)]
pub struct Run {
    /// The run's `config.toml`, as a learner wrote it that had presets in place of tasks, and no
    /// choice of the device.
    config: Table,
    /// The lines of its `scores.jsonl`.
    pub scores: Vec<serde_json::Value>,
}

/// Writes the runs of runs.toml, which says what its keys mean.
pub fn write_runs() {
    let runs: Table = include_str!("runs.toml").parse().unwrap();
    for (folder, run) in runs.iter().filter(|(folder, _)| !folder.starts_with('_')) {
        let mut run = inherited(&runs, run);
        let Some(means) = run.remove("means") else {
            Run::new(&run).write(folder);
            continue;
        };
        for (seed, mean) in (0i64..).zip(means.as_array().unwrap()) {
            run.insert("seed".to_owned(), seed.into());
            run.insert("mean".to_owned(), mean.clone());
            Run::new(&run).write(format!("{folder}/{seed}"));
        }
    }
}

fn inherited(runs: &Table, run: &Value) -> Table {
    let base = run.get("like").and_then(Value::as_str);
    let mut keys = base.map(|base| inherited(runs, &runs[base])).unwrap_or_default();
    keys.extend(run.as_table().unwrap().clone());
    keys
}

fn number(value: &Value) -> f64 {
    value.as_float().or(value.as_integer().map(|number| number as f64)).unwrap()
}

impl Run {
    /// A run by the keys of runs.toml.
    pub fn new(keys: &Table) -> Self {
        let text = |key, other| keys.get(key).and_then(Value::as_str).unwrap_or(other);
        let (task, algorithm) = (text("task", "hopper-demo"), text("algorithm", "quad"));
        let seed = keys.get("seed").and_then(Value::as_integer).unwrap_or_default();
        let changes = toml::toml! { algorithm = algorithm seed = seed };
        let experiment = Table::try_from(resolve(task, &changes).unwrap()).unwrap();
        let run = toml::toml! { name = "r" preset = task incarnation = 1 version = "0" };
        let dataset = toml::toml! {
            path = "data.hdf5"
            transitions = 100
            episodes = 3
            min_return = 10.0
            mean_return = 20.0
            max_return = 30.0
            mean_score = 10.7
        };
        let config = toml::toml! { run = run dataset = dataset experiment = experiment };
        let mut run = Self { config, scores: Vec::new() };
        for (key, value) in keys.iter().filter(|(key, _)| key.contains('.')) {
            run.set(key, value.clone());
        }
        run.score_all(keys);
        for line in &mut run.scores {
            line["precision"] = text("precision", "f32-avx512").into();
            if keys.contains_key("returns") {
                line["return"] = line["score"].clone();
            }
        }
        run
    }

    fn score_all(&mut self, keys: &Table) {
        if let Some(mean) = keys.get("mean") {
            let value = |key| keys.get(key).map(number);
            let planned = |key| self.config["experiment"][key].as_integer().unwrap() as u64;
            let (interval, episodes) = (planned("eval_interval"), planned("episodes"));
            let (rise, count) = (value("rise").unwrap_or_default(), value("count").unwrap());
            for index in 1..=count as u64 {
                let score = number(mean) + rise * (index as f64 - (count + 1.0) / 2.0);
                let score = value("first").filter(|_| index == 1).unwrap_or(score);
                (0..episodes).for_each(|seed| self.score(interval * index, seed, score, "00"));
            }
        }
        let evaluations = keys.get("scores").and_then(Value::as_array);
        for evaluation in evaluations.into_iter().flatten() {
            let (step, scores) = evaluation.as_array().unwrap().split_first().unwrap();
            for (seed, score) in (0..).zip(scores) {
                self.score(number(step) as u64, seed, number(score), "00");
            }
        }
    }

    /// Changes a value by its dotted key; false removes it.
    fn set(&mut self, key: &str, value: Value) {
        let (tables, key) = key.rsplit_once('.').unwrap();
        let mut table = &mut self.config;
        for key in tables.split('.') {
            table = table[key].as_table_mut().unwrap();
        }
        match value.as_bool() {
            Some(false) => table.remove(key),
            _ => table.insert(key.to_owned(), value),
        };
    }

    /// Scores an episode.
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

    pub fn write(&self, path: impl AsRef<Path>) {
        let path = path.as_ref();
        fs::create_dir_all(path.join("snapshots")).unwrap();
        fs::write(path.join("config.toml"), self.config.to_string()).unwrap();
        fs::write(path.join("scores.jsonl"), self.lines()).unwrap();
    }

    /// The run's `scores.jsonl`.
    pub fn lines(&self) -> String {
        self.scores.iter().map(|line| format!("{line}\n")).collect()
    }
}
