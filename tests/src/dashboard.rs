//! The Grafana dashboard: what its panels ask Prometheus.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;

use crate::eventually;
use crate::prometheus::Prometheus;

/// Values of a panel's variables, for all runs.
const VARIABLES: [(&str, &str); 2] = [("$run", ".*"), ("$__rate_interval", "1m")];

/// Asks every query of every panel until it returns data.
pub fn assert_every_panel_shows_data(prometheus: &Prometheus, patience: Duration) {
    for (panel, expression) in queries() {
        let what = format!("panel {panel:?} has data for {expression}");
        eventually(&what, patience, || {
            prometheus.query(&expression).filter(|values| !values.is_empty())
        });
    }
}

/// The metrics that training measures, as the panels call them: by their names, without the number
/// at the end.
pub fn metrics() -> BTreeSet<String> {
    let is_name =
        |name: &str| name.chars().all(|c| c.is_ascii_lowercase() || c == '_' || c.is_ascii_digit());
    let titles = queries().into_iter().map(|(title, _)| title);
    let of_names = titles.filter(|title| title.split(", ").all(is_name));
    of_names.flat_map(|title| title.split(", ").map(str::to_owned).collect::<Vec<_>>()).collect()
}

fn queries() -> Vec<(String, String)> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/grafana/dashboards/quad.json");
    let text = fs::read_to_string(&path).expect("the dashboard is there");
    let dashboard: Value = serde_json::from_str(&text).expect("the dashboard is JSON");
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let mut queries = Vec::new();
    for panel in list(&dashboard["panels"]) {
        for target in list(&panel["targets"]) {
            let expression = target["expr"].as_str().expect("a target has an expression");
            let replace = |text: String, (name, value): &(&str, &str)| text.replace(name, value);
            let expression = VARIABLES.iter().fold(expression.to_owned(), replace);
            assert!(
                !expression.contains('$'),
                "a variable that this test does not know: {expression}"
            );
            queries.push((panel["title"].as_str().unwrap_or_default().to_owned(), expression));
        }
    }
    assert!(queries.len() > 20, "the dashboard has {} queries", queries.len());
    queries
}
