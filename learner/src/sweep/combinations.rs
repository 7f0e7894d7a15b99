//! Combinations of a study's axes, the names of their runs, and rules that select some. A rule has a
//! value, or a list of values, for some axes; `*` stands for any letters.

use std::path::Path;

use quad_algorithms::fits;
use quad_run::config::tables;
use toml::{Table, Value};

/// A key as after `--set`, or `task`, `preset`, `method`; and at least one value, all different.
pub(super) type Axis = (String, Vec<Value>);

/// A value of each axis, in the order of the axes.
pub(super) type Combination<'a> = Vec<(&'a str, &'a Value)>;

/// The axes of a table, or all problems with them. Seeds change last: an interrupted study has
/// compared everything by some seeds, and more seeds only extend the list.
pub(super) fn axes(table: &Table) -> Result<Vec<Axis>, Vec<String>> {
    let (mut axes, mut problems) = (Vec::new(), Vec::new());
    for (key, value) in tables::keys(table) {
        let Some(values) = value.as_array() else {
            problems.push(format!("axis {key} is {value}, but must be a list: {key} = [{value}]"));
            continue;
        };
        if values.is_empty() {
            problems.push(format!("axis {key} has no values"));
        }
        let mut indexed = values.iter().enumerate();
        if let Some((_, value)) = indexed.find(|(index, value)| values[..*index].contains(value)) {
            problems.push(format!("axis {key} has the value {value} twice"));
        }
        axes.push((key, values.clone()));
    }
    if axes.is_empty() && problems.is_empty() {
        problems.push("[axes] names no axis, such as seed = [0, 1, 2]".to_owned());
    }
    let order = ["seed", "task", "preset", "dataset", "algorithm", "method"];
    axes.sort_by_key(|(key, _)| order.iter().position(|first| first == key).unwrap_or(order.len()));
    if problems.is_empty() { Ok(axes) } else { Err(problems) }
}

/// The Cartesian product of the axes, the last axis changing first.
pub(super) fn combinations(axes: &[Axis]) -> Vec<Combination<'_>> {
    let mut combinations = vec![Combination::new()];
    for (key, values) in axes {
        let longer = combinations.iter().flat_map(|start| {
            values.iter().map(move |value| [&start[..], &[(&**key, value)]].concat())
        });
        combinations = longer.collect();
    }
    combinations
}

/// The name of a combination's run, the seed last: `hopper-demo-quad-tau0.1-seed3`. It includes axes
/// of one value, so that further values change no name.
pub(super) fn name(combination: &Combination<'_>) -> String {
    let mut seed_last = combination.clone();
    seed_last.sort_by_key(|(key, _)| *key == "seed");
    let last = |key: &str| key.rsplit('.').next().unwrap_or_default().to_owned();
    let part = |(key, value): &(&str, &Value)| {
        // The key, if another axis ends like it.
        let same = combination.iter().filter(|(other, _)| last(other) == last(key)).count();
        let short = if same == 1 { last(key) } else { (*key).to_owned() };
        match (*key, value.as_str()) {
            ("preset" | "dataset", Some(path)) if path.contains(['/', '.']) => {
                allowed(&Path::new(path).file_stem().unwrap_or_default().to_string_lossy())
            }
            ("task" | "method" | "algorithm" | "preset" | "dataset", Some(word)) => allowed(word),
            ("dataset", None) => allowed(&value.to_string()),
            (_, Some(word)) => format!("{short}-{}", allowed(word)),
            (_, None) => format!("{short}{}", allowed(&value.to_string())),
        }
    };
    Vec::from_iter(seed_last.iter().map(part)).join("-")
}

/// With a dash for each sequence of characters that are not allowed in a name.
fn allowed(text: &str) -> String {
    let parts = text.split(|c: char| !(c.is_ascii_alphanumeric() || "._-".contains(c)));
    Vec::from_iter(parts.filter(|part| !part.is_empty())).join("-")
}

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

/// The unknown axis of a rule, or that the rule matches nothing.
pub(super) fn problem(rule: &Table, combinations: &[Combination<'_>]) -> Option<String> {
    let axes = Vec::from_iter(combinations.first()?.iter().map(|(key, _)| *key));
    if let Some((key, _)) = tables::keys(rule).iter().find(|(key, _)| !axes.contains(&&**key)) {
        return Some(format!("names {key}, which is no axis; there are {}", axes.join(", ")));
    }
    let matches_any = combinations.iter().any(|combination| matches(rule, combination));
    let text = rule.to_string();
    (!matches_any).then(|| format!("fits no combination: {}", text.trim().replace('\n', ", ")))
}
