//! The axes of a study: lists of values, which are combined.

use quad_run::config::tables;
use toml::{Table, Value};

#[derive(Clone, Debug, PartialEq)]
pub(super) struct Axis {
    /// A key as after `--set`, or `task`, `preset`, `method`.
    pub key: String,
    /// At least one, all different.
    pub values: Vec<Value>,
}

/// A value of each axis, in the order of the axes.
pub(super) type Combination<'a> = Vec<(&'a str, &'a Value)>;

/// The axes of a table, or all problems with them. The values of the first axis change last.
pub(super) fn axes(table: &Table) -> Result<Vec<Axis>, Vec<String>> {
    let (mut axes, mut problems) = (Vec::new(), Vec::new());
    for (key, value) in tables::keys(table) {
        let Some(values) = value.as_array().cloned() else {
            let list = format!("{key} = [{value}]");
            problems.push(format!("axis {key} is {value}, but must be a list: {list}"));
            continue;
        };
        if values.is_empty() {
            problems.push(format!("axis {key} has no values"));
        }
        let is_repeated = |(at, value): &(usize, &Value)| values[..*at].contains(value);
        if let Some((_, value)) = values.iter().enumerate().find(is_repeated) {
            problems.push(format!("axis {key} has the value {value} twice"));
        }
        axes.push(Axis { key, values });
    }
    if axes.is_empty() && problems.is_empty() {
        problems.push("[axes] names no axis, such as seed = [0, 1, 2]".to_owned());
    }
    axes.sort_by_key(|axis| rank(&axis.key));
    match problems[..] {
        [] => Ok(axes),
        _ => Err(problems),
    }
}

/// Seeds change last: an interrupted study has compared everything by some seeds, and more seeds
/// only extend the list.
fn rank(key: &str) -> usize {
    let order = ["seed", "task", "preset", "dataset", "algorithm", "method"];
    let place = order.iter().position(|known| *known == key);
    place.unwrap_or(order.len())
}

/// The Cartesian product of the axes, the last axis changing first.
pub(super) fn combinations(axes: &[Axis]) -> Vec<Combination<'_>> {
    let mut all = vec![Combination::new()];
    for Axis { key, values } in axes {
        let mut longer = Vec::new();
        for prefix in &all {
            let with = |value| [&prefix[..], &[(&**key, value)]].concat();
            longer.extend(values.iter().map(with));
        }
        all = longer;
    }
    all
}
