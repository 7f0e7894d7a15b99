//! Scores that the QUAD paper publishes for its tasks: the table `published.toml`.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

/// Training seeds behind a figure of the paper (section 5.1).
pub const SEEDS: usize = 4;

/// What a method is published to score on a task.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Published {
    /// The method, as the paper calls it.
    pub method: &'static str,
    /// Its D4RL-normalised score.
    pub score: Printed,
    /// Where it stands.
    pub source: &'static str,
    /// The paper's tables that have the method.
    #[serde(skip)]
    pub tables: &'static [u8],
    /// What the figure does not show.
    pub remarks: Vec<Remark>,
}

/// What is known to be wrong or peculiar of a figure.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Remark {
    /// What it is, in words.
    pub reason: &'static str,
    /// The figure with which the reason ends, if it ends with one.
    pub instead: Option<f64>,
    /// Whether the figure is the best of several, by the very returns that it reports.
    pub selected: bool,
}

/// A figure as it is printed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Printed {
    /// The mean over seeds.
    pub mean: f64,
    /// What stands behind its ±, if it has one. The paper does not say which convention that follows.
    pub std: Option<f64>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Tables {
    method: Vec<Method>,
    /// Scores by task and method: the mean, and where there is one the deviation.
    scores: BTreeMap<String, BTreeMap<String, Vec<f64>>>,
    remark: Vec<KnownRemark>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Method {
    name: String,
    source: String,
    tables: Vec<u8>,
    /// Ours of that method, and its variant.
    algorithm: Option<String>,
    variant: Option<String>,
}

/// A remark on figures of some methods.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct KnownRemark {
    methods: Vec<String>,
    /// How the names of its tasks begin; empty: any task.
    #[serde(default)]
    tasks: Vec<String>,
    /// The figure with which the reason ends, by task; empty: it ends with none.
    #[serde(default)]
    instead: BTreeMap<String, f64>,
    reason: String,
    #[serde(default)]
    selected: bool,
}

impl KnownRemark {
    /// The remark, if it is about this figure.
    fn on(&'static self, method: &str, task: &str) -> Option<Remark> {
        let is_of_task = match (self.tasks.is_empty(), self.instead.is_empty()) {
            (true, true) => true,
            (true, false) => self.instead.contains_key(task),
            (false, _) => self.tasks.iter().any(|start| task.starts_with(start)),
        };
        let is_on = is_of_task && self.methods.iter().any(|known| known == method);
        let instead = self.instead.get(task).copied();
        is_on.then_some(Remark { reason: &self.reason, instead, selected: self.selected })
    }
}

#[allow(clippy::expect_used)] // The tables are part of the program; the test here reads them.
static TABLES: LazyLock<Tables> =
    LazyLock::new(|| toml::from_str(include_str!("../../published.toml")).expect("the embedded tables are valid"));

/// What is published for a task, the paper's own method first; nothing for tasks that are not the paper's.
pub fn scores(task: &str) -> Vec<Published> {
    let scores = TABLES.scores.get(task);
    let published = |method: &'static Method| {
        let figures = scores?.get(&method.name)?;
        let score = Printed { mean: *figures.first()?, std: figures.get(1).copied() };
        let remarks = TABLES.remark.iter().filter_map(|known| known.on(&method.name, task)).collect();
        let Method { name, source, tables, .. } = method;
        Some(Published { method: name, score, source, tables, remarks })
    };
    TABLES.method.iter().filter_map(published).collect()
}

/// Whether a table of the paper has a row or column of an algorithm of ours, in any of its variants.
pub fn is_in(table: u8, algorithm: &str) -> bool {
    let is_it = |method: &Method| method.tables.contains(&table) && method.algorithm.as_deref() == Some(algorithm);
    TABLES.method.iter().any(is_it)
}

/// What the paper calls a variant of an algorithm: several names where it has several rows, none where it has none.
pub fn methods(algorithm: &str, variant: &str) -> Vec<&'static str> {
    let is_it = |method: &&Method| {
        method.algorithm.as_deref() == Some(algorithm) && method.variant.as_deref().is_none_or(|known| known == variant)
    };
    TABLES.method.iter().filter(is_it).map(|method| &*method.name).collect()
}

#[cfg(test)]
mod tests;
