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
    /// By preset and method: the mean, and where there is one the deviation.
    scores: BTreeMap<String, BTreeMap<String, Vec<f64>>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Method {
    name: String,
    source: String,
}

#[allow(clippy::expect_used)] // The tables are part of the program; the test here reads them.
static TABLES: LazyLock<Tables> =
    LazyLock::new(|| toml::from_str(include_str!("../../published.toml")).expect("the embedded tables are valid"));

/// What is published for the task of a preset, the paper's own method first; nothing for other presets.
pub fn scores(preset: &str) -> Vec<Published> {
    let scores = TABLES.scores.get(preset);
    let published = |method: &'static Method| {
        let figures = scores?.get(&method.name)?;
        let score = Printed { mean: *figures.first()?, std: figures.get(1).copied() };
        Some(Published { method: &method.name, score, source: &method.source })
    };
    TABLES.method.iter().filter_map(published).collect()
}

#[cfg(test)]
#[path = "../../tests/unit/report/published.rs"]
mod tests;
