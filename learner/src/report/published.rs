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
mod tests {
    use super::*;

    /// The columns of Table 1 add up to the totals that it gives; published.toml names the three that do not.
    #[test]
    fn columns_add_up_to_the_totals_of_the_paper() {
        let total = |method: &str, tasks: &[&str]| {
            let of_task = |(preset, scores): (&String, &BTreeMap<String, Vec<f64>>)| {
                let counts = tasks.iter().any(|task| preset.starts_with(task));
                counts.then(|| scores.get(method).map(|figures| figures[0]))
            };
            let scores: Option<Vec<f64>> = TABLES.scores.iter().filter_map(of_task).collect();
            scores.map(|scores| (scores.len(), (scores.iter().sum::<f64>() * 10.0).round() / 10.0))
        };
        for (method, locomotion, antmaze) in [
            ("Onestep-RL", 684.6, Some(125.3)),
            ("CQL", 698.5, Some(303.6)),
            ("IQL", 692.6, Some(378.0)),
            ("IVR", 749.7, Some(432.0)),
            ("EQL", 752.9, Some(420.9)),
            ("Diffuser", 678.0, None),
            ("DTQL", 798.3, Some(453.8)),
            ("AlignIQL", 681.1, Some(462.4)),
            ("SfBC", 680.3, Some(445.4)),
            ("DQL", 791.2, Some(417.8)),
            ("DAC", 836.4, Some(459.9)),
            ("QUAD", 842.8, Some(489.0)),
        ] {
            assert_eq!(total(method, &["hopper", "walker2d", "halfcheetah"]), Some((9, locomotion)), "{method}");
            assert_eq!(total(method, &["antmaze"]), antmaze.map(|antmaze| (6, antmaze)), "{method}");
        }
    }

    #[test]
    fn table_2_has_seven_tasks() {
        let scores: Vec<_> = TABLES.scores.values().filter_map(|scores| scores.get("DAC-Rep")).collect();
        assert_eq!(scores.len(), 7);
        let sum = |n: usize| (scores.iter().map(|figures| figures[n]).sum::<f64>() * 10.0).round() / 10.0;
        assert_eq!((sum(0), sum(1)), (511.8, 58.1));
    }

    #[test]
    fn every_score_has_a_method_and_the_papers_own_has_a_deviation() {
        for (preset, methods) in &TABLES.scores {
            let published = scores(preset);
            assert_eq!(published.len(), methods.len(), "{preset}");
            assert!(published[0].method == "QUAD" && published[0].score.std.is_some(), "{preset}");
        }
        assert_eq!(scores("hopper-demo"), []);
    }
}
