//! What the files of a run say: a line of each log, and where the learner is.

use std::io::ErrorKind;
use std::path::Path;

use anyhow::Context;
use quad_algorithms::MetricsLine;
use quad_protocol::{EpisodeScore, ScoreReport};
use serde::{Deserialize, Serialize};

use crate::files;

/// Where a learner can be reached: `endpoints.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunEndpoints {
    /// Zenoh endpoints that an evaluator can connect to.
    pub zenoh: Vec<String>,
    /// Address of `/metrics`.
    pub metrics: String,
    /// The page that shows the run to a browser; older runs have none.
    #[serde(default)]
    pub page: String,
}

/// A line of `scores.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ScoreLine {
    /// Gradient step of the evaluated snapshot.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Undiscounted return.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Environment steps.
    pub length: u32,
    /// D4RL-normalized score.
    pub score: f64,
    /// BLAKE3 of the snapshot's file.
    pub weights: String,
    /// Arithmetic that the policy was computed in, e.g. `f32-avx2` or `bf16-amx`; lines from before
    /// there was a choice do not say.
    #[serde(default)]
    pub precision: String,
    /// Who measured it.
    pub evaluator: String,
}

impl ScoreLine {
    /// The line for an episode of a report.
    pub fn new(report: &ScoreReport, score: &EpisodeScore) -> Self {
        Self {
            step: report.step,
            seed: score.seed,
            episode_return: score.episode_return,
            length: score.length,
            score: score.score,
            weights: report.weights.to_string(),
            precision: report.precision.to_string(),
            evaluator: report.evaluator.to_string(),
        }
    }

    /// The episode of the line.
    pub fn episode(&self) -> EpisodeScore {
        let Self { seed, episode_return, length, score, .. } = *self;
        EpisodeScore { seed, episode_return, length, score }
    }
}

/// The lines of `metrics.jsonl` in a run folder; none if there is no such file. The last one may
/// not be complete.
///
/// # Errors
/// The file cannot be read.
pub fn read_metrics(folder: &Path) -> anyhow::Result<Vec<MetricsLine>> {
    let path = folder.join("metrics.jsonl");
    match files::read_text(&path) {
        Ok(text) => Ok(text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()),
        Err(error) if error.kind() == ErrorKind::NotFound => Ok(Vec::new()),
        Err(error) => Err(error).with_context(|| format!("cannot read {}", path.display())),
    }
}

#[cfg(test)]
mod tests;
