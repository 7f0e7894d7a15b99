//! The pages of metrics as Prometheus reads them.

use std::io::Write;
use std::process::{Command, Stdio};

use quad_tests::setting::ENDLESS;
use quad_tests::system::Scratch;
use quad_tests::{http, peers};

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
