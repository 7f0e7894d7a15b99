//! An algorithm's file of hyper-parameters: what all tasks share, and what groups of tasks have of their own.
//!
//! `[for."PATTERN"]` holds keys of an experiment for the tasks that fit the pattern, in which `*` stands for any letters. Of
//! several such groups the one whose pattern has more letters wins.

use std::collections::BTreeMap;

use anyhow::{Context, anyhow};
use quad_service::hinted;
use serde::Deserialize;
use toml::Table;

use super::nearest::did_you_mean;
use super::tables::merge;
use super::tasks::Task;
use crate::algorithms::{ALGORITHMS, Definition};

/// The file of one algorithm.
#[derive(Debug, Deserialize)]
pub struct Values {
    /// What the algorithm is, in a few words.
    pub about: String,
    /// Patterns of the tasks for which its authors give values.
    pub given: Vec<String>,
    /// Keys of an experiment by pattern.
    #[serde(rename = "for", default)]
    groups: BTreeMap<String, Table>,
    /// Keys of an experiment that all tasks share.
    #[serde(flatten)]
    shared: Table,
}

impl Values {
    /// Those of an algorithm.
    ///
    /// # Errors
    /// Its file is broken, which a test of each excludes.
    pub fn of(definition: &Definition) -> anyhow::Result<Self> {
        toml::from_str(definition.settings).with_context(|| format!("the file of algorithm {}", definition.name))
    }

    /// Keys of an experiment for a task; without one, what all tasks share.
    pub fn for_task(&self, task: Option<&str>) -> Table {
        let of_task = |pattern: &str| task.is_some_and(|task| fits(pattern, task));
        let mut groups: Vec<_> = self.groups.iter().filter(|(pattern, _)| of_task(pattern)).collect();
        groups.sort_by_key(|(pattern, _)| letters(pattern));
        let mut table = self.shared.clone();
        groups.into_iter().for_each(|(_, keys)| merge(&mut table, keys.clone()));
        table
    }

    /// Whether a benchmark of others, a task with a dataset of its own, has no values by the algorithm's authors.
    pub fn lacks(&self, task: &Task) -> bool {
        task.word("dataset").is_some() && !self.given.iter().any(|pattern| fits(pattern, &task.name))
    }
}

/// A sentence about a task for which an algorithm's authors give no values; none of others.
///
/// # Errors
/// As [`Values::of`].
pub fn not_given(definition: &Definition, task: &Task) -> anyhow::Result<Option<String>> {
    let lacks = Values::of(definition)?.lacks(task);
    let (algorithm, task) = (definition.name, &task.name);
    Ok(lacks.then(|| format!("not given by the authors of {algorithm}: values for {task}; those of other tasks hold")))
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

/// Whether a name fits a pattern, in which `*` stands for any letters.
pub fn fits(pattern: &str, name: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == name,
        Some((before, after)) => name.strip_prefix(before).is_some_and(|rest| {
            let mut ends = rest.char_indices().map(|(end, _)| end).chain([rest.len()]);
            ends.any(|end| fits(after, &rest[end..]))
        }),
    }
}

fn letters(pattern: &str) -> usize {
    pattern.chars().filter(|letter| *letter != '*').count()
}

#[cfg(test)]
#[path = "../../tests/unit/config/hyperparameters.rs"]
mod tests;
