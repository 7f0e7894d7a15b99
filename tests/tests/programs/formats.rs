//! Our files and metrics as other programs read them: Python's safetensors, Prometheus.

use std::io::Write;
use std::process::{Command, Stdio};

use quad_tests::setting::{ENDLESS, SHORT};
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, http, peers};
use serde_json::Value;

#[test]
fn python_reads_a_snapshot() {
    let Some(python) = peers::python(&["safetensors", "numpy"]) else { return };
    let scratch = Scratch::new();
    let mut learner = scratch.learner_with("run", SHORT, &["--eval-interval", "0"]);
    learner.process.assert_succeeds(PATIENCE);
    let printed =
        peers::run_python(&python, "snapshot_shapes.py", &[&learner.snapshot(SHORT.steps)]);
    let shapes: Value = serde_json::from_str(&printed).unwrap();
    // Hopper: 11 observations, 3 actions; 32 time features; 2 critics; 16 wide.
    for (tensor, shape) in [
        ("actor.time.0.kernel", &[16, 32][..]),
        ("actor.trunk.0.kernel", &[46, 16]),
        ("actor.trunk.3.bias", &[3]),
        ("critic.0.kernel", &[2, 14, 16]),
        ("critic.3.bias", &[2, 1]),
    ] {
        assert_eq!(shapes[tensor], serde_json::json!(shape), "{tensor}");
    }
}

#[test]
fn prometheus_understands_both_metrics_pages() {
    if !peers::has_prometheus() {
        return;
    }
    let scratch = Scratch::new();
    let learner = scratch.learner("run", ENDLESS);
    let evaluator = scratch.evaluator("seen", &learner.endpoint());
    learner.wait_for_scores(0);
    for address in [learner.metrics(), evaluator.metrics()] {
        assert_eq!(http::get(&address, "/healthz").unwrap().0, 200, "{address}");
        let page = http::metrics(&address).unwrap();
        let mut command = Command::new("promtool");
        command
            .args(["check", "metrics"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut promtool = command.spawn().unwrap();
        promtool.stdin.take().unwrap().write_all(page.as_bytes()).unwrap();
        let output = promtool.wait_with_output().unwrap();
        let complaints =
            String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && complaints.is_empty(), "{complaints}\n{page}");
    }
}
