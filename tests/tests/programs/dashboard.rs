//! Grafana's files: sound by its schema, and every panel shows data of a running system.

use std::path::Path;

use quad_tests::setting::ENDLESS;
use quad_tests::system::Scratch;
use quad_tests::{PATIENCE, dashboard, peers, prometheus};

#[test]
fn provisioning_follows_the_schema() {
    let Some(python) = peers::python(&["jsonschema", "yaml"]) else { return };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/grafana");
    peers::run_python(&python, "grafana_files.py", &[&folder]);
}

#[test]
fn every_panel_shows_data() {
    if !peers::has_prometheus() {
        return;
    }
    let scratch = Scratch::new();
    let learner = scratch.learner("run", ENDLESS);
    let evaluators = ["first", "second"].map(|name| scratch.evaluator(name, &learner.endpoint()));
    let pages = evaluators.each_ref().map(|evaluator| evaluator.metrics());
    let jobs: [(&str, &[String]); 2] = [("learner", &[learner.metrics()]), ("evaluator", &pages)];
    let prometheus = prometheus::start(&scratch, &jobs);
    dashboard::assert_every_panel_shows_data(&prometheus, PATIENCE);
}
