//! The axes of a study: lists of values, which are combined.

use quad_run::config::tables;
use toml::{Table, Value};

/// One axis.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Axis {
    /// A key as after `--set`, or `task`, `preset`, `method`.
    pub key: String,
    /// Values of the axis: at least one; no two are the same.
    pub values: Vec<Value>,
}

/// A value of each axis, in the order of the axes.
pub(super) type Combination<'a> = Vec<(&'a str, &'a Value)>;

/// The axes of a table, the one whose values change last first; or all that is wrong with them.
pub(super) fn axes(table: &Table) -> Result<Vec<Axis>, Vec<String>> {
    let (mut axes, mut wrong) = (Vec::new(), Vec::new());
    for (key, value) in tables::keys(table) {
        match value.as_array() {
            None => {
                wrong.push(format!("axis {key} is {value}, but must be a list: {key} = [{value}]"))
            }
            Some(values) if values.is_empty() => wrong.push(format!("axis {key} has no values")),
            Some(values) => {
                let twice =
                    values.iter().enumerate().find(|(at, value)| values[..*at].contains(value));
                wrong.extend(
                    twice.map(|(_, value)| format!("axis {key} has the value {value} twice")),
                );
                axes.push(Axis { key, values: values.clone() });
            }
        }
    }
    if axes.is_empty() && wrong.is_empty() {
        wrong.push("[axes] names no axis, such as seed = [0, 1, 2]".to_owned());
    }
    axes.sort_by_key(|axis| rank(&axis.key));
    if wrong.is_empty() { Ok(axes) } else { Err(wrong) }
}

/// Seeds change last: a study that is broken off has compared everything by some seeds, and further
/// ones only add to the list.
fn rank(key: &str) -> usize {
    let order = ["seed", "task", "preset", "dataset", "algorithm", "method"];
    order.iter().position(|known| *known == key).unwrap_or(order.len())
}

/// Every combination, the last axis changing first.
pub(super) fn combinations(axes: &[Axis]) -> Vec<Combination<'_>> {
    let mut all = vec![Combination::new()];
    for Axis { key, values } in axes {
        let mut longer = Vec::new();
        for begun in &all {
            longer.extend(values.iter().map(|value| [&begun[..], &[(&**key, value)]].concat()));
        }
        all = longer;
    }
    all
}
