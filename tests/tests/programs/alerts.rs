//! Prometheus's alert rules: they fire when they should, what they ask for exists, and each is explained.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use quad_tests::peers;

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn read(path: &str) -> String {
    fs::read_to_string(repository(path)).unwrap()
}

#[test]
fn each_fires_when_it_should_and_only_then() {
    if !peers::has_prometheus() {
        return;
    }
    for (arguments, file) in [
        (["test", "rules"], "deploy/prometheus/alerts.test.yml"),
        (["check", "config"], "deploy/prometheus/prometheus.yml"),
    ] {
        let output = Command::new("promtool").args(arguments).arg(repository(file)).output().unwrap();
        let text = [output.stdout, output.stderr].concat();
        assert!(output.status.success(), "{file}: {}", String::from_utf8_lossy(&text));
    }
}

#[test]
fn each_is_tested_and_explained_and_asks_for_what_is_documented() {
    let (rules, tests) = (read("deploy/prometheus/alerts.yml"), read("deploy/prometheus/alerts.test.yml"));
    let (operations, metrics) = (read("docs/operations.md"), read("docs/metrics.md"));
    let alerts: Vec<&str> = rules.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")).collect();
    assert!(alerts.len() > 10, "{alerts:?}");
    for alert in alerts {
        assert!(operations.contains(&format!("\n### {alert}\n")), "docs/operations.md has no section {alert}");
        let runbook = format!("runbook: docs/operations.md#{}\n", alert.to_ascii_lowercase());
        assert!(rules.contains(&runbook), "{alert} does not lead to its section");
        assert!(tests.contains(&format!("alertname=\"{alert}\"")), "{alert} fires in no test");
    }
    let words = rules.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    let asked: BTreeSet<&str> = words.filter(|word| word.starts_with("quad_")).collect();
    assert!(asked.len() > 8, "{asked:?}");
    for metric in asked {
        let documented = [format!("`{metric}`"), format!("`{metric}{{")].iter().any(|name| metrics.contains(name));
        assert!(documented, "docs/metrics.md has no {metric}");
    }
}
