//! Rules select combinations of a study's axes. A rule has a value, or a list of values, for some
//! axes; `*` stands for any letters.

use quad_algorithms::fits;
use quad_run::config::tables;
use toml::{Table, Value};

use super::axes::Combination;

/// Merges rules `AXIS=VALUE` into one, by which each axis has one of the values given for it.
pub(super) fn merge(rules: &[Table]) -> Table {
    let mut merged = Table::new();
    for (key, value) in rules.iter().flat_map(tables::keys) {
        let values = merged.entry(key).or_insert_with(|| Value::Array(Vec::new()));
        if let Value::Array(values) = values {
            values.push(value.clone());
        }
    }
    merged
}

pub(super) fn matches(rule: &Table, combination: &Combination<'_>) -> bool {
    tables::keys(rule).iter().all(|(key, wanted)| {
        combination.iter().any(|(axis, value)| axis == key && is(value, wanted))
    })
}

fn is(value: &Value, wanted: &Value) -> bool {
    match (value, wanted) {
        (value, Value::Array(several)) => several.iter().any(|wanted| is(value, wanted)),
        (Value::String(value), Value::String(pattern)) => fits(pattern, value),
        (Value::Float(value), Value::Integer(wanted)) => *value == *wanted as f64,
        (value, wanted) => value == wanted,
    }
}

/// Finds an unknown axis in a rule, or that the rule matches nothing.
pub(super) fn problem(rule: &Table, combinations: &[Combination<'_>]) -> Option<String> {
    let axes = Vec::from_iter(combinations.first()?.iter().map(|(key, _)| *key));
    if let Some((key, _)) = tables::keys(rule).iter().find(|(key, _)| !axes.contains(&&**key)) {
        return Some(format!("names {key}, which is no axis; there are {}", axes.join(", ")));
    }
    let matches_any = combinations.iter().any(|combination| matches(rule, combination));
    let text = rule.to_string();
    (!matches_any).then(|| format!("fits no combination: {}", text.trim().replace('\n', ", ")))
}
