//! Algorithms by name, and the tasks for which their authors give values.

use quad_algorithms::{ALGORITHMS, Definition, Values, fits};

use super::error::{ConfigError, did_you_mean};
use super::tasks::Task;

/// A warning about a benchmark's task for which an algorithm's authors give no values.
pub fn not_given(definition: &Definition, task: &Task) -> Option<String> {
    let values = Values::read(definition);
    let given = task.benchmark.and_then(|benchmark| values.given.get(&benchmark.name));
    let is_given = given.is_some_and(|tasks| tasks.iter().any(|pattern| fits(pattern, &task.name)));
    // A task without a dataset of its own is no benchmark's.
    if is_given || task.text("dataset").is_none() {
        return None;
    }
    let instead = match (task.values_task(), values.group_for(&task.name)) {
        (other, _) if other != task.name => format!("those for {other} are used"),
        (_, Some(group)) => format!("those for {group} are used"),
        _ => "its general values are used".to_owned(),
    };
    let (algorithm, name) = (definition.name, &task.name);
    Some(format!("{algorithm}'s authors give no values for {name}; {instead}"))
}

/// Finds an algorithm by name.
pub fn algorithm(name: &str) -> Result<Definition, ConfigError> {
    let unknown = || {
        let similar = did_you_mean(name, ALGORITHMS.iter().map(|definition| definition.name));
        let hint = format!("{similar}there are {}", names_where(|_| true));
        ConfigError::unknown("algorithm", name, hint)
    };
    ALGORITHMS.iter().find(|definition| definition.name == name).copied().ok_or_else(unknown)
}

/// Names of some algorithms.
pub(super) fn names_where(can: impl Fn(&Definition) -> bool) -> String {
    let algorithms = ALGORITHMS.iter().filter(|algorithm| can(algorithm));
    Vec::from_iter(algorithms.map(|algorithm| algorithm.name)).join(", ")
}

#[cfg(test)]
mod tests;
