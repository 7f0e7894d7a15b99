//! `evaluator score` measures what a run measured.

use std::path::Path;

use quad_tests::PATIENCE;
use quad_tests::learner::Learner;
use quad_tests::process::succeeds;
use quad_tests::setting::Setting;
use quad_tests::system::Scratch;
use serde_json::{Value, json};

const SETTING: Setting = Setting {
    steps: 40,
    eval_interval: 20,
    episodes: 7,
    candidates: 3,
    hidden: 16,
    seed: 5,
    online_steps: 0,
};

/// A finished run, evaluated in the arithmetic of that name.
fn run(scratch: &Scratch, name: &str, precision: &str, scale: &[&str]) -> Learner {
    let listen = ["--listen", "tcp/127.0.0.1:0"];
    let mut learner = scratch.learner_with(name, SETTING, &[&listen, scale].concat());
    let connect =
        ["--connect", &learner.endpoint(), "--http", "127.0.0.1:0", "--precision", precision];
    let _evaluator = scratch.evaluator_with(&format!("evaluator-of-{name}"), &connect);
    learner.process.assert_succeeds(PATIENCE);
    learner
}

fn score(snapshots: &[&Path], flags: &str) -> Vec<Value> {
    let paths = Vec::from_iter(snapshots.iter().map(|path| path.to_str().unwrap())).join(" ");
    serde_json::from_str(&succeeds(&format!("evaluator score {paths} --json {flags}"))).unwrap()
}

/// Seed, length, and the bits of return and score of each episode.
fn episodes(scored: &Value) -> Vec<(u64, u64, u64, u64)> {
    let bits = |number: &Value| number.as_f64().unwrap().to_bits();
    let whole = |number: &Value| number.as_u64().unwrap();
    let episodes = scored["episodes"].as_array().unwrap().iter();
    episodes
        .map(|of| {
            (whole(&of["seed"]), whole(&of["length"]), bits(&of["return"]), bits(&of["score"]))
        })
        .collect()
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
        let learner = run(&scratch, name, precision, scale);
        let steps = SETTING.evaluated_steps();
        let snapshots: Vec<_> = steps.iter().map(|&step| learner.snapshot(step)).collect();
        let snapshots: Vec<&Path> = snapshots.iter().map(AsRef::as_ref).collect();
        let scored = score(&snapshots, &format!("--precision {precision}"));
        assert_eq!(scored.len(), steps.len());
        for ((scored, &step), snapshot) in scored.iter().zip(&steps).zip(snapshots) {
            let of_run: Vec<_> =
                learner.scores().into_iter().filter(|score| score.step == step).collect();
            let same = |field: &str, value: &str| assert_eq!(scored[field], value, "{field}");
            same("snapshot", snapshot.to_str().unwrap());
            same("weights", &of_run[0].weights);
            same("precision", &of_run[0].precision);
            assert_eq!(scored["step"], step);
            assert_eq!(
                scored["choice"],
                json!({ "candidates": SETTING.candidates, "aggregate": "mean", "rule": "best" })
            );
            let mut of_run: Vec<_> = of_run
                .iter()
                .map(|s| (s.seed, s.length.into(), s.episode_return.to_bits(), s.score.to_bits()))
                .collect();
            let mut again = episodes(scored);
            of_run.sort_unstable();
            again.sort_unstable();
            assert_eq!(again, of_run, "step {step}, {name}");
        }
    }
}

#[test]
fn candidates_rules_and_values_are_chosen_at_scoring() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("unscored", SETTING, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    let snapshot = learner.snapshot(SETTING.steps);
    let flags = "--candidates 1,3 --rule softmax:0.5 --aggregate min";
    let guided = "--aggregate mean-minus-std:1 --guidance 0.5";
    let [softmax, best, guided] =
        [flags, "", guided].map(|flags| score(&[&snapshot], &format!("--episodes 2 {flags}")));
    let rule = json!({ "softmax": { "temperature": 0.5 } });
    for (scored, candidates) in softmax.iter().zip([1, 3]) {
        let choice = json!({ "candidates": candidates, "aggregate": "min", "rule": rule });
        assert_eq!(scored["choice"], choice);
    }
    let choice = json!({ "candidates": SETTING.candidates, "aggregate": "mean-minus-std:1", "rule": "best", "guidance": 0.5 });
    assert_eq!(guided[0]["choice"], choice);
    let all = [&softmax[0], &softmax[1], &best[0], &guided[0]].map(episodes);
    let own_way = all.windows(2).all(|two| two[0] != two[1]);
    assert!(own_way, "each chooses in its own way: {all:?}");
}
