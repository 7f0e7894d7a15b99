//! An algorithm's file of hyper-parameters: what all tasks share, and what groups of tasks have of
//! their own.
//!
//! `[for."PATTERN"]` holds keys of an experiment for the tasks that fit the pattern, in which `*`
//! stands for any text; but only a pattern with OGBench's [`MARK`] fits its tasks. Of several such
//! groups the one whose pattern has more letters wins.

use std::collections::BTreeMap;

use serde::Deserialize;
use toml::{Table, Value};

use crate::Definition;

/// In the name of each of OGBench's tasks, and of no other's.
const MARK: &str = "-singletask-";

/// The file of one algorithm.
#[derive(Debug, Deserialize)]
pub struct Values {
    /// A short description of the algorithm.
    pub about: String,
    /// Cost of a gradient step with the values for `hopper-medium-v2`: billions of additions and
    /// multiplications in the products of its networks. Two cores do some 100 to 200 a second.
    pub gflop: String,
    /// Patterns of the tasks for which its authors give values, by benchmark.
    pub given: BTreeMap<String, Vec<String>>,
    /// Keys of an experiment by pattern.
    #[serde(rename = "for", default)]
    groups: BTreeMap<String, Table>,
    /// Keys of an experiment that all tasks share.
    #[serde(flatten)]
    shared: Table,
}

impl Values {
    /// Reads an algorithm's values.
    #[allow(clippy::expect_used)] // The file is part of the program; a test reads each.
    pub fn read(definition: &Definition) -> Self {
        toml::from_str(definition.presets).expect("the embedded values are valid")
    }

    /// Keys of an experiment for a task; without one, what all tasks share.
    pub fn for_task(&self, task: Option<&str>) -> Table {
        let groups = task.map_or_else(Vec::new, |task| self.groups_for(task));
        let mut table = self.shared.clone();
        groups.into_iter().for_each(|(_, keys)| merge(&mut table, keys.clone()));
        table
    }

    /// The pattern of the group that wins for a task, if one has it.
    pub fn group_for(&self, task: &str) -> Option<&str> {
        self.groups_for(task).pop().map(|(pattern, _)| &**pattern)
    }

    /// The groups of a task, the winning one last.
    fn groups_for(&self, task: &str) -> Vec<(&String, &Table)> {
        let is_for =
            |pattern: &str| fits(pattern, task) && pattern.contains(MARK) == task.contains(MARK);
        let mut groups: Vec<_> =
            self.groups.iter().filter(|(pattern, _)| is_for(pattern)).collect();
        groups.sort_by_key(|(pattern, _)| letters(pattern));
        groups
    }
}

/// True if a name fits a pattern, in which `*` stands for any text.
pub fn fits(pattern: &str, name: &str) -> bool {
    match pattern.split_once('*') {
        None => pattern == name,
        Some((before, after)) => name.strip_prefix(before).is_some_and(|rest| {
            let mut ends = rest.char_indices().map(|(end, _)| end).chain([rest.len()]);
            ends.any(|end| fits(after, &rest[end..]))
        }),
    }
}

/// Lays `changes` over `table`: tables key by key, anything else in place of what was there. An
/// integer that takes a number's place becomes one, so that 1 and 1.0 are the same setting.
pub fn merge(table: &mut Table, changes: Table) {
    for (key, change) in changes {
        match (table.get_mut(&key), change) {
            (Some(Value::Table(below)), Value::Table(change)) => merge(below, change),
            (Some(Value::Float(below)), Value::Integer(change)) => *below = change as f64,
            (_, change) => drop(table.insert(key, change)),
        }
    }
}

fn letters(pattern: &str) -> usize {
    pattern.chars().filter(|letter| *letter != '*').count()
}

#[cfg(test)]
mod tests;
