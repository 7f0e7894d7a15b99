//! Prometheus and Grafana: they understand our metrics, rules and files, and find data of a running
//! system.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use quad_tests::process::stdout;
use quad_tests::prometheus::Prometheus;
use quad_tests::setting::ENDLESS;
use quad_tests::system::Scratch;
use quad_tests::{http, peers};

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Runs promtool, which must succeed; gives what it said.
fn promtool(arguments: &[&str], file: &Path) -> String {
    let mut command = Command::new("promtool");
    let output = command.args(arguments).stdin(fs::File::open(file).unwrap()).output().unwrap();
    let text = String::from_utf8([output.stdout, output.stderr].concat()).unwrap();
    assert!(output.status.success(), "{arguments:?}: {text}");
    text
}

#[test]
fn alerts_fire_in_their_cases_only() {
    if !peers::has("prometheus", "--version") {
        return;
    }
    for (arguments, file) in [
        (["test", "rules"], "deploy/prometheus/alerts.test.yml"),
        (["check", "config"], "deploy/prometheus/prometheus.yml"),
    ] {
        let path = repository(file);
        promtool(&[&arguments[..], &[path.to_str().unwrap()]].concat(), &path);
    }
}

#[test]
fn grafanas_files_follow_the_schema_and_alerts_are_documented() {
    let Some(python) = peers::python("jsonschema, yaml") else { return };
    for (script, argument) in [("grafana_files.py", "deploy/grafana"), ("alert_files.py", ".")] {
        let script = repository("tests/peers").join(script);
        let output = Command::new(&python).arg(script).arg(repository(argument)).output();
        stdout(&output.unwrap());
    }
}

#[test]
fn prometheus_understands_every_page_and_fills_every_panel() {
    if !peers::has("prometheus", "--version") {
        return;
    }
    let scratch = Scratch::new();
    let learner = scratch.learner("run", ENDLESS);
    let evaluators = ["first", "second"].map(|name| scratch.evaluator(name, &learner.endpoint()));
    let pages = evaluators.each_ref().map(|evaluator| evaluator.wait_for_address("/metrics"));
    learner.wait_for_scores(1);
    for address in [&learner.metrics(), &pages[0]] {
        assert_eq!(http::get(address, "/healthz").unwrap().0, 200, "{address}");
        let page = scratch.path().join("page");
        fs::write(&page, http::metrics(address).unwrap()).unwrap();
        assert_eq!(promtool(&["check", "metrics"], &page), "", "{address}");
    }
    let jobs: [(&str, &[String]); 2] = [("learner", &[learner.metrics()]), ("evaluator", &pages)];
    Prometheus::start(&scratch, &jobs).assert_every_panel_shows_data();
}
