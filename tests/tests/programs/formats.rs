//! What we write and serve, as others read it: Python's safetensors, h5py, Prometheus.

use std::fs;
use std::io::Write;
use std::process::{Command, Stdio};

use quad_tests::process::{Process, binary};
use quad_tests::setting::{ENDLESS, SHORT};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, eventually, http, peers, prometheus};
use serde_json::Value;

#[test]
fn python_reads_a_snapshot() {
    let Some(python) = peers::python(&["safetensors", "numpy"]) else { return };
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("run", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    let printed = peers::run_python(&python, "snapshot_shapes.py", &[&learner.snapshot(SHORT.steps)]);
    let shapes: Value = serde_json::from_str(&printed).unwrap();
    // Hopper: 11 observations, 3 actions; 32 time features; 2 critics; 16 wide.
    let expected = serde_json::json!({
        "actor.time.0.kernel": [16, 32], "actor.time.0.bias": [32],
        "actor.time.1.kernel": [32, 32], "actor.time.1.bias": [32],
        "actor.trunk.0.kernel": [46, 16], "actor.trunk.0.bias": [16],
        "actor.trunk.1.kernel": [16, 16], "actor.trunk.1.bias": [16],
        "actor.trunk.2.kernel": [16, 16], "actor.trunk.2.bias": [16],
        "actor.trunk.3.kernel": [16, 3], "actor.trunk.3.bias": [3],
        "critic.0.kernel": [2, 14, 16], "critic.0.bias": [2, 16],
        "critic.1.kernel": [2, 16, 16], "critic.1.bias": [2, 16],
        "critic.2.kernel": [2, 16, 16], "critic.2.bias": [2, 16],
        "critic.3.kernel": [2, 16, 1], "critic.3.bias": [2, 1],
    });
    assert_eq!(shapes, expected);
}

#[test]
fn h5py_reads_a_recorded_dataset_and_the_learner_trains_on_it() {
    let Some(python) = peers::python(&["h5py", "numpy"]) else { return };
    let scratch = Scratch::new();
    let recorded = scratch.dataset();
    fs::remove_file(&recorded).unwrap();
    let mut command = Command::new(binary("evaluator"));
    command.args(["collect", "--env", "hopper", "--transitions", "3000", "--seed", "3", "--out"]).arg(&recorded);
    Process::start("collect", scratch.path(), command).assert_succeeds(PATIENCE);

    let printed = peers::run_python(&python, "dataset_layout.py", &[&recorded]);
    let layout: Value = serde_json::from_str(&printed).unwrap();
    let rows = layout["rewards"]["shape"][0].as_u64().unwrap();
    assert!(rows >= 3000, "{rows} rows");
    for (name, width, dtype) in [
        ("observations", Some(11), "float32"),
        ("actions", Some(3), "float32"),
        ("next_observations", Some(11), "float32"),
        ("rewards", None, "float32"),
        ("terminals", None, "bool"),
        ("timeouts", None, "bool"),
        ("infos/qpos", Some(6), "float32"),
        ("infos/qvel", Some(6), "float32"),
    ] {
        let shape: Vec<u64> = [rows].into_iter().chain(width).collect();
        let (found, kind) = (&layout[name]["shape"], layout[name]["dtype"].as_str());
        assert_eq!((found, kind), (&serde_json::json!(shape), Some(dtype)), "{name}");
        assert_eq!(layout[name]["finite"], true, "{name}");
    }

    let mut learner = scratch.learner_with("run", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
}

#[test]
fn prometheus_scrapes_both_and_answers_for_the_score() {
    if !peers::has_prometheus() {
        return;
    }
    let scratch = Scratch::new();
    let learner = scratch.learner("run", ENDLESS);
    let evaluator = scratch.evaluator("seen", &learner.endpoint());
    // Without a metrics page: Prometheus sees it by what its progress tells the learner.
    let _hidden = scratch.evaluator_with("hidden", &["--connect", &learner.endpoint()]);
    let pages = [learner.metrics(), evaluator.metrics()];

    let (_process, prometheus) = prometheus::start(&scratch, &[("quad", &pages)]);
    let score =
        eventually("Prometheus knows the score", PATIENCE, || prometheus.value("quad_learner_evaluation_score"));
    assert!((-10.0..150.0).contains(&score), "{score}");
    for expression in [
        "quad_evaluator_episodes_total",
        r#"quad_learner_evaluator_episodes{evaluator="seen"}"#,
        r#"quad_learner_evaluator_episodes{evaluator="hidden"}"#,
        r#"quad_learner_evaluator_environment_steps{evaluator="hidden"}"#,
    ] {
        eventually(expression, PATIENCE, || prometheus.value(expression).filter(|value| *value > 0.0));
    }

    for address in &pages {
        assert_eq!(http::get(address, "/healthz").unwrap().0, 200, "{address}");
        let page = http::metrics(address).unwrap();
        let mut command = Command::new("promtool");
        command.args(["check", "metrics"]).stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut promtool = command.spawn().unwrap();
        promtool.stdin.take().unwrap().write_all(page.as_bytes()).unwrap();
        let output = promtool.wait_with_output().unwrap();
        let complaints = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && complaints.is_empty(), "{complaints}\n{page}");
    }
}
