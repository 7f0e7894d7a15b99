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
    /// By task and method: the mean, and where there is one the deviation.
    scores: BTreeMap<String, BTreeMap<String, Vec<f64>>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Method {
    name: String,
    source: String,
    /// Ours of that method, and its variant.
    algorithm: Option<String>,
    variant: Option<String>,
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
        Some(Published { method: &method.name, score, source: &method.source })
    };
    TABLES.method.iter().filter_map(published).collect()
}

/// What the paper calls a variant of an algorithm: several names where it has several rows, none where it has none.
pub fn methods(algorithm: &str, variant: &str) -> Vec<&'static str> {
    let is_it = |method: &&Method| {
        method.algorithm.as_deref() == Some(algorithm) && method.variant.as_deref().is_none_or(|known| known == variant)
    };
    TABLES.method.iter().filter(is_it).map(|method| &*method.name).collect()
}

#[cfg(test)]
#[path = "../../tests/unit/report/published.rs"]
mod tests;
