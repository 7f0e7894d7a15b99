//! Algorithms by name, and the tasks for which their authors give values.

use quad_algorithms::{ALGORITHMS, Definition, Values, fits};

use super::error::ConfigError;
use super::nearest::did_you_mean;
use super::tasks::Task;

/// True if an algorithm's authors give no values for a benchmark's task. A task without a dataset
/// of its own is no benchmark's.
fn lacks(values: &Values, task: &Task) -> bool {
    let given = task.benchmark.and_then(|benchmark| values.given.get(&benchmark.name));
    let is_given = given.into_iter().flatten().any(|pattern| fits(pattern, &task.name));
    task.text("dataset").is_some() && !is_given
}

/// A warning about a task for which an algorithm's authors give no values.
pub fn not_given(definition: &Definition, task: &Task) -> Option<String> {
    let instead = match task.values_of() {
        own if own == task.name => "its general values are used".to_owned(),
        other => format!("those for {other} are used"),
    };
    let (algorithm, name) = (definition.name, &task.name);
    lacks(&Values::of(definition), task)
        .then(|| format!("{algorithm}'s authors give no values for {name}; {instead}"))
}

/// Finds an algorithm by name.
pub fn algorithm(name: &str) -> Result<Definition, ConfigError> {
    let unknown = || {
        let names = Vec::from_iter(ALGORITHMS.iter().map(|known| known.name));
        let hint =
            format!("{}there are {}", did_you_mean(name, names.iter().copied()), names.join(", "));
        ConfigError::Unknown { kind: "algorithm", name: name.to_owned(), hint }
    };
    ALGORITHMS.iter().find(|known| known.name == name).copied().ok_or_else(unknown)
}

#[cfg(test)]
mod tests;
