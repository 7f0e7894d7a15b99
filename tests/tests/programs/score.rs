//! `evaluator score` measures what a run measured, and says clearly what it cannot score.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use quad_tests::PATIENCE;
use quad_tests::learner::Learner;
use quad_tests::process::binary;
use quad_tests::setting::Setting;
use quad_tests::system::Scratch;
use serde_json::{Value, json};

const SETTING: Setting =
    Setting { steps: 40, eval_interval: 20, episodes: 7, candidates: 3, hidden: 16, seed: 5 };

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

fn score(threads: &str, snapshots: &[&Path], flags: &[&str]) -> Output {
    let mut command = Command::new(binary("evaluator"));
    command
        .env("RAYON_NUM_THREADS", threads)
        .arg("score")
        .args(snapshots)
        .args(flags)
        .output()
        .unwrap()
}

fn read(output: &Output) -> Vec<Value> {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
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

/// Whether or not the policy learned from scaled data: the simulator's units go in and come out.
#[test]
fn a_snapshot_gets_the_scores_that_its_run_has() {
    let scratch = Scratch::new();
    for (name, precision, scale) in [
        ("exact", "f32", &[][..]),
        ("rounded", "bf16", &[]),
        ("scaled", "f32", &["--scale", "states,actions"]),
    ] {
        let learner = run(&scratch, name, precision, scale);
        let steps = SETTING.evaluated_steps();
        let snapshots: Vec<_> = steps.iter().map(|&step| learner.snapshot(step)).collect();
        let snapshots: Vec<&Path> = snapshots.iter().map(AsRef::as_ref).collect();
        let scored = read(&score("2", &snapshots, &["--precision", precision, "--json"]));
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
                json!({ "candidates": SETTING.candidates, "value": "mean", "rule": "best" })
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
fn what_cannot_be_scored_is_said_in_a_sentence() {
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("unscored", SETTING, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    let snapshot = fs::read(learner.snapshot(SETTING.steps)).unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = scratch.path().join(name);
        fs::write(&path, bytes).unwrap();
        path
    };
    // Of the same length, so the rest of the file stays what it is.
    let with = |from: &str, to: &str| {
        let at = snapshot.windows(from.len()).position(|window| window == from.as_bytes()).unwrap();
        [&snapshot[..at], to.as_bytes(), &snapshot[at + to.len()..]].concat()
    };
    let whole = write("whole.safetensors", &snapshot);
    let moon = write("moon.safetensors", &with("hopper", "onmoon"));
    let cut = write("cut.safetensors", &snapshot[..snapshot.len() / 2]);
    let missing = scratch.path().join("missing.safetensors");
    for (path, flags, words) in [
        (&cut, &[][..], "is not a saved policy"),
        (&missing, &[], "cannot read"),
        (&moon, &[], "unknown environment `onmoon`"),
        (&whole, &["--env", "walker2d"], "walker2d"),
    ] {
        let output = score("1", &[path], flags);
        let text = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{path:?}: {text}");
        let told =
            text.contains(words) && text.contains(path.to_str().unwrap()) && text.contains("hint:");
        assert!(told && output.stdout.is_empty(), "{path:?}: {text}");
    }
    let scored = read(&score("1", &[&moon], &["--env", "hopper", "--episodes", "2", "--json"]));
    assert_eq!(episodes(&scored[0]).len(), 2);

    let nearest = score("1", &[&whole], &["--rule", "nearest"]);
    let text = String::from_utf8_lossy(&nearest.stderr);
    assert!(text.contains("value function") && text.contains("hint: score it without"), "{text}");
    let flags = [
        "--episodes",
        "2",
        "--candidates",
        "1,3",
        "--rule",
        "softmax:0.5",
        "--value",
        "min",
        "--json",
    ];
    let (softmax, best) = (
        read(&score("1", &[&whole], &flags)),
        read(&score("1", &[&whole], &["--episodes", "2", "--json"])),
    );
    let rule = json!({ "softmax": { "temperature": 0.5 } });
    let choice =
        |candidates: u32| json!({ "candidates": candidates, "value": "min", "rule": rule });
    assert_eq!([&softmax[0]["choice"], &softmax[1]["choice"]], [&choice(1), &choice(3)]);
    let all = [&softmax[0], &softmax[1], &best[0]].map(episodes);
    assert!(all[0] != all[1] && all[1] != all[2], "each chooses in its own way: {all:?}");
}
