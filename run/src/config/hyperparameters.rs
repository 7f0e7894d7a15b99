//! Algorithms by name, and the tasks for which their authors give values.

use quad_algorithms::{ALGORITHMS, Definition, Values, fits};

use super::error::{ConfigError, did_you_mean};
use super::tasks::Task;

/// True if an algorithm's authors give no values for a benchmark's task. A task without a dataset
/// of its own is no benchmark's.
fn lacks(values: &Values, task: &Task) -> bool {
    let given = task.benchmark.and_then(|benchmark| values.given.get(&benchmark.name));
    let is_given = given.is_some_and(|tasks| tasks.iter().any(|pattern| fits(pattern, &task.name)));
    task.text("dataset").is_some() && !is_given
}

/// A warning about a task for which an algorithm's authors give no values.
pub fn not_given(definition: &Definition, task: &Task) -> Option<String> {
    let values = Values::of(definition);
    let instead = match (task.values_of(), values.group_for(&task.name)) {
        (other, _) if other != task.name => format!("those for {other} are used"),
        (_, Some(group)) => format!("those for {group} are used"),
        _ => "its general values are used".to_owned(),
    };
    let (algorithm, name) = (definition.name, &task.name);
    let warning = format!("{algorithm}'s authors give no values for {name}; {instead}");
    lacks(&values, task).then_some(warning)
}

/// Finds an algorithm by name.
pub fn algorithm(name: &str) -> Result<Definition, ConfigError> {
    let unknown = || {
        let names = Vec::from_iter(ALGORITHMS.iter().map(|definition| definition.name));
        let similar = did_you_mean(name, names.iter().copied());
        let hint = format!("{similar}there are {}", names.join(", "));
        ConfigError::unknown("algorithm", name, hint)
    };
    ALGORITHMS.iter().find(|definition| definition.name == name).copied().ok_or_else(unknown)
}

#[cfg(test)]
mod tests;
