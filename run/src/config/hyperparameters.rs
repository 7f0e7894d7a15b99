//! Algorithms by name, and the tasks for which their authors give values.

use anyhow::anyhow;
use quad_algorithms::{ALGORITHMS, Definition, Values, fits};
use quad_dataset::ogbench::is_ogbench;
use quad_runtime::hinted;

use super::nearest::did_you_mean;
use super::tasks::Task;

/// Whether a benchmark of others, a task with a dataset of its own, has no values by the
/// algorithm's authors.
fn lacks(values: &Values, task: &Task) -> bool {
    // OGBench numbers its tasks apart from D4RL: a pattern like `*-v0` is not about them unless it
    // says so.
    let is_about = |pattern: &String| {
        is_ogbench(pattern) == is_ogbench(&task.name) && fits(pattern, &task.name)
    };
    task.word("dataset").is_some() && !values.given.iter().any(is_about)
}

/// A sentence about a task for which an algorithm's authors give no values; none of others.
///
/// # Errors
/// As [`Values::of`].
pub fn not_given(definition: &Definition, task: &Task) -> anyhow::Result<Option<String>> {
    let lacking = lacks(&Values::of(definition)?, task);
    let instead = match task.valued_as() {
        own if own == task.name => "its general values are used".to_owned(),
        other => format!("those for {other} are used"),
    };
    let (algorithm, task) = (definition.name, &task.name);
    Ok(lacking.then(|| format!("{algorithm}'s authors give no values for {task}; {instead}")))
}

/// The algorithm of that name.
///
/// # Errors
/// There is none; the hint has similar names.
pub fn algorithm(name: &str) -> anyhow::Result<Definition> {
    let unknown = || hinted(anyhow!("there is no algorithm named {name}"), unknown_hint(name));
    ALGORITHMS.into_iter().find(|known| known.name == name).ok_or_else(unknown)
}

/// What to do about a name that no algorithm has.
pub fn unknown_hint(name: &str) -> String {
    let names = ALGORITHMS.map(|known| known.name);
    format!("{}there are {}", did_you_mean(name, names), names.join(", "))
}

#[cfg(test)]
mod tests;
