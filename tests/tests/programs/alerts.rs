//! Prometheus's alert rules: they fire when they should, what they ask for exists, and each says
//! what to do.

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
fn alerts_fire_in_their_cases_only() {
    if !peers::has_prometheus() {
        return;
    }
    for (arguments, file) in [
        (["test", "rules"], "deploy/prometheus/alerts.test.yml"),
        (["check", "config"], "deploy/prometheus/prometheus.yml"),
    ] {
        let output =
            Command::new("promtool").args(arguments).arg(repository(file)).output().unwrap();
        let text = [output.stdout, output.stderr].concat();
        assert!(output.status.success(), "{file}: {}", String::from_utf8_lossy(&text));
    }
}

#[test]
fn alerts_are_tested_explained_and_documented() {
    let (rules, tests) =
        (read("deploy/prometheus/alerts.yml"), read("deploy/prometheus/alerts.test.yml"));
    let metrics = read("docs/metrics.md");
    let alerts: Vec<_> =
        rules.split("- alert: ").skip(1).filter_map(|rule| rule.split_once('\n')).collect();
    assert!(alerts.len() > 10, "{alerts:?}");
    for (alert, rule) in alerts {
        let said = rule
            .split_once("description: >-\n")
            .map_or(0, |(_, text)| text.split_whitespace().count());
        assert!(rule.contains("summary: ") && said >= 15, "{alert} says too little of what to do");
        assert!(tests.contains(&format!("alertname=\"{alert}\"")), "{alert} fires in no test");
    }
    let words = rules.split(|c: char| !c.is_ascii_alphanumeric() && c != '_');
    let asked: BTreeSet<&str> = words.filter(|word| word.starts_with("quad_")).collect();
    assert!(asked.len() > 8, "{asked:?}");
    for metric in asked {
        let documented = [format!("`{metric}`"), format!("`{metric}{{")]
            .iter()
            .any(|name| metrics.contains(name));
        assert!(documented, "docs/metrics.md has no {metric}");
    }
}
