//! Debian's Prometheus, and what the panels of Grafana's dashboard ask it.

use std::collections::BTreeSet;
use std::fs;
use std::process::Command;

use serde_json::Value;

use crate::process::Process;
use crate::system::Scratch;
use crate::{eventually, http};

const RULES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/prometheus/alerts.yml");
const DASHBOARD: &str =
    concat!(env!("CARGO_MANIFEST_DIR"), "/../deploy/grafana/dashboards/quad.json");
/// Values of a panel's variables, for all runs.
const VARIABLES: [(&str, &str); 2] = [("$run", ".*"), ("$__rate_interval", "1m")];

pub struct Prometheus {
    address: String,
    _process: Process,
}

impl Prometheus {
    /// Starts one with our alert rules, which scrapes the pages of each job every second.
    pub fn start(scratch: &Scratch, jobs: &[(&str, &[String])]) -> Prometheus {
        let configuration = scratch.path().join("prometheus.yml");
        let mut text = format!(
            "global:\n  evaluation_interval: 500ms\nrule_files: [{RULES:?}]\nscrape_configs:\n"
        );
        for (job, pages) in jobs {
            text.push_str(&format!(
                "- job_name: {job}\n  scrape_interval: 1s\n  static_configs:\n  - targets: {pages:?}\n"
            ));
        }
        fs::write(&configuration, text).expect("the scratch folder is writable");
        let mut command = Command::new("prometheus");
        command.arg(format!("--config.file={}", configuration.display()));
        command.arg(format!("--storage.tsdb.path={}", scratch.path().join("tsdb").display()));
        command.args(["--web.listen-address=127.0.0.1:0", "--log.format=json"]);
        let process = Process::start("prometheus", scratch.path(), command);
        let address = eventually("Prometheus listens", || {
            let log = process.log();
            let mut lines = log.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
            let line = lines.find(|line| line["msg"] == "Listening on")?;
            line["address"].as_str().map(str::to_owned)
        });
        Prometheus { address, _process: process }
    }

    /// Asks every query of every panel until it returns data.
    pub fn assert_every_panel_shows_data(&self) {
        for (panel, expression) in queries() {
            let what = format!("panel {panel:?} has data for {expression}");
            eventually(&what, || self.query(&expression).filter(|values| !values.is_empty()));
        }
    }

    /// The values of an expression now, one for each series that has a finite one; nothing without
    /// an answer.
    fn query(&self, expression: &str) -> Option<Vec<f64>> {
        let path = format!("/api/v1/query?query={}", percent_encoded(expression));
        let (_, body) = http::get(&self.address, &path)?;
        let answer: Value = serde_json::from_str(&body).ok()?;
        assert_eq!(answer["status"], "success", "{expression}: {answer}");
        let series = answer["data"]["result"].as_array()?.iter();
        let values = series.filter_map(|one| one["value"][1].as_str()?.parse().ok());
        Some(values.filter(|value: &f64| value.is_finite()).collect())
    }
}

fn percent_encoded(text: &str) -> String {
    let encode = |byte: u8| match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'_' => char::from(byte).to_string(),
        _ => format!("%{byte:02X}"),
    };
    text.bytes().map(encode).collect()
}

/// The metrics that training measures, as the panels call them: by their names.
pub fn training_metrics() -> BTreeSet<String> {
    let is_letter = |c: char| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit();
    let is_list = |title: &String| title.split(", ").all(|name| name.chars().all(is_letter));
    let titles = Vec::from_iter(queries().into_iter().map(|(title, _)| title).filter(is_list));
    titles.iter().flat_map(|title| title.split(", ").map(str::to_owned)).collect()
}

/// Title of the panel, and expression.
fn queries() -> Vec<(String, String)> {
    let text = fs::read_to_string(DASHBOARD).expect("the dashboard is there");
    let dashboard: Value = serde_json::from_str(&text).expect("the dashboard is JSON");
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let mut queries = Vec::new();
    for panel in list(&dashboard["panels"]) {
        for target in list(&panel["targets"]) {
            let expression = target["expr"].as_str().expect("a target has an expression");
            let replace = |text: String, (name, value): &(&str, &str)| text.replace(name, value);
            let expression = VARIABLES.iter().fold(expression.to_owned(), replace);
            assert!(!expression.contains('$'), "an unknown variable: {expression}");
            queries.push((panel["title"].as_str().unwrap_or_default().to_owned(), expression));
        }
    }
    assert!(queries.len() > 20, "the dashboard has {} queries", queries.len());
    queries
}
