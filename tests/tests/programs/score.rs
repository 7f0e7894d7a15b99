//! `evaluator score` measures what a run measured.

use std::path::PathBuf;

use quad_tests::learner::Learner;
use quad_tests::process::succeeds;
use quad_tests::setting::{SHORT, Setting};
use quad_tests::system::Scratch;
use serde_json::Value;

pub const SETTING: Setting = Setting { steps: 40, episodes: 7, candidates: 3, ..SHORT };

/// A finished run, evaluated in the arithmetic of that name.
pub fn finished_run(scratch: &Scratch, name: &str, precision: &str, scale: &[&str]) -> Learner {
    let listen = ["--listen", "tcp/127.0.0.1:0"];
    let mut learner = scratch.learner_with(name, SETTING, &[&listen, scale].concat());
    let connect = ["--connect", &learner.endpoint(), "--precision", precision];
    let _evaluator = scratch.evaluator_with(&format!("evaluator-{name}"), &connect);
    learner.process.assert_ends(0);
    learner
}

fn score(snapshots: &[PathBuf], flags: &str) -> Vec<Value> {
    let paths = Vec::from_iter(snapshots.iter().map(|path| path.to_str().unwrap())).join(" ");
    serde_json::from_str(&succeeds(&format!("evaluator score {paths} --json {flags}"))).unwrap()
}

/// Seed, length, and the bits of return and score of each episode, sorted.
fn episodes(scored: &Value) -> Vec<(u64, u64, u64, u64)> {
    let bits = |number: &Value| number.as_f64().unwrap().to_bits();
    let whole = |number: &Value| number.as_u64().unwrap();
    let episodes = scored["episodes"].as_array().unwrap().iter();
    let mut episodes = Vec::from_iter(episodes.map(|episode| {
        let [seed, length] = ["seed", "length"].map(|key| whole(&episode[key]));
        let [episode_return, score] = ["return", "score"].map(|key| bits(&episode[key]));
        (seed, length, episode_return, score)
    }));
    episodes.sort_unstable();
    episodes
}

/// A policy takes and gives the simulator's units, also if it learned from scaled data.
#[test]
fn a_snapshot_gets_the_scores_that_its_run_has() {
    let scratch = Scratch::new();
    for (name, precision, scale) in [
        ("exact", "f32", &[][..]),
        ("rounded", "bf16", &[]),
        ("scaled", "f32", &["--normalize", "observations,actions"]),
    ] {
        let learner = finished_run(&scratch, name, precision, scale);
        let snapshots = [20, 40].map(|step| learner.snapshot(step));
        let scored = score(&snapshots, &format!("--precision {precision}"));
        assert_eq!(scored.len(), 2);
        for ((scored, step), snapshot) in scored.iter().zip([20, 40]).zip(snapshots) {
            let mut scores = learner.scores();
            scores.retain(|score| score.step == step);
            let first = &scores[0];
            assert_eq!(scored["snapshot"], snapshot.to_str().unwrap());
            assert_eq!(scored["weights"], *first.weights);
            assert_eq!(scored["precision"], *first.precision);
            assert_eq!(scored["step"], step);
            let mut recorded = Vec::from_iter(scores.iter().map(|score| {
                let [episode_return, normalized] = [score.episode_return, score.score];
                let length = u64::from(score.length);
                (score.seed, length, episode_return.to_bits(), normalized.to_bits())
            }));
            recorded.sort_unstable();
            assert_eq!(episodes(scored), recorded, "step {step}, {name}");
        }
    }
}
