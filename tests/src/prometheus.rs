//! Debian's Prometheus.

use std::fs;
use std::path::Path;
use std::process::Command;

use serde_json::Value;

use crate::http;
use crate::process::Process;
use crate::system::{Scratch, free_port};

pub struct Prometheus {
    address: String,
    _process: Process,
}

/// Starts Debian's Prometheus with our alert rules, which scrapes the pages of each job every
/// second.
pub fn start(scratch: &Scratch, jobs: &[(&str, &[String])]) -> Prometheus {
    let configuration = scratch.path().join("prometheus.yml");
    let rules = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/prometheus/alerts.yml");
    let mut text = format!(
        "global:\n  evaluation_interval: 500ms\nrule_files: [{rules:?}]\nscrape_configs:\n"
    );
    for (job, pages) in jobs {
        text.push_str(&format!("- job_name: {job}\n  scrape_interval: 1s\n  scrape_timeout: 1s\n"));
        text.push_str(&format!("  static_configs:\n  - targets: {pages:?}\n"));
    }
    fs::write(&configuration, text).expect("the scratch folder is writable");
    let address = format!("127.0.0.1:{}", free_port());
    let mut command = Command::new("prometheus");
    command.arg(format!("--config.file={}", configuration.display()));
    command.arg(format!("--storage.tsdb.path={}", scratch.path().join("tsdb").display()));
    command.arg(format!("--web.listen-address={address}"));
    Prometheus { address, _process: Process::start("prometheus", scratch.path(), command) }
}

impl Prometheus {
    /// The values of an expression now, one for each series that has a finite one; nothing without
    /// an answer.
    pub fn query(&self, expression: &str) -> Option<Vec<f64>> {
        let (_, body) = http::get(
            &self.address,
            &format!("/api/v1/query?query={}", percent_encoded(expression)),
        )?;
        let answer: Value = serde_json::from_str(&body).ok()?;
        assert_eq!(answer["status"], "success", "{expression}: {answer}");
        let series = answer["data"]["result"].as_array()?;
        let values = series.iter().filter_map(|one| one["value"][1].as_str()?.parse().ok());
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
