//! Contents of run folders for the tests of this crate and of the learner.

use quad_run::config::{RunConfig, resolve};
use quad_run::folder::ScoreLine;
use serde_json::json;

/// The configuration of a run with two episodes per evaluation.
pub fn config(name: &str, seed: u64) -> RunConfig {
    let mut experiment = resolve("hopper-demo", &Default::default()).unwrap();
    (experiment.seed, experiment.episodes) = (seed, 2);
    let run = json!({ "name": name, "incarnation": 1, "task": "hopper-demo", "version": "0.1.0" });
    let dataset = json!({
        "transitions": 100, "episodes": 3, "min_return": 10.0, "mean_return": 20.0, "max_return": 30.0, "mean_score": 10.7,
        "files": [{ "path": "data.hdf5", "transitions": 100, "episodes": 3 }],
    });
    serde_json::from_value(json!({ "run": run, "dataset": dataset, "experiment": experiment }))
        .unwrap()
}

/// A line of `scores.jsonl`.
pub fn line(step: u64, seed: u64, score: f64) -> ScoreLine {
    serde_json::from_value(json!({
        "step": step, "seed": seed, "return": 10.0 * score, "length": 5, "score": score, "weights": "00",
        "precision": "f32", "evaluator": "e",
    }))
    .unwrap()
}
