//! What tests of several modules write into run folders.

use quad_runs::config::{DatasetInfo, Device, RunConfig, RunInfo, resolve};
use quad_runs::run::ScoreLine;
use toml::Table;

/// The configuration of a run.
pub fn config(name: &str, seed: u64) -> RunConfig {
    let mut experiment = resolve("hopper-demo", &Table::new()).unwrap();
    (experiment.seed, experiment.episodes) = (seed, 2);
    RunConfig {
        run: RunInfo {
            name: name.into(),
            started: 1,
            task: "hopper-demo".into(),
            version: "0.1.0".into(),
            machine: None,
            device: Device::Cpu,
        },
        dataset: DatasetInfo {
            path: "data.hdf5".into(),
            sha256: None,
            transitions: 100,
            episodes: 3,
            min_return: 10.0,
            mean_return: 20.0,
            max_return: 30.0,
            mean_score: Some(10.7),
        },
        experiment,
    }
}

/// A line of `scores.jsonl`.
pub fn line(step: u64, seed: u64, score: f64) -> ScoreLine {
    ScoreLine {
        step,
        seed,
        episode_return: 10.0 * score,
        length: 5,
        score,
        weights: "00".into(),
        precision: "f32".into(),
        evaluator: "e".into(),
    }
}
