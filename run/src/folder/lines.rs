//! Contents of a run's files: a line of each log, and the learner's addresses.

use std::path::Path;

use quad_algorithms::MetricsLine;
use quad_protocol::{EpisodeScore, ScoreReport};
use serde::{Deserialize, Serialize};

use super::error::{RunDirError, io_error};
use crate::files;

/// Addresses of a learner: `endpoints.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunEndpoints {
    /// Zenoh endpoints that evaluators can connect to.
    pub zenoh: Vec<String>,
    /// Address of `/metrics`.
    pub metrics: String,
    /// Web page of the run; older runs have none.
    #[serde(default)]
    pub page: String,
}

/// A line of `scores.jsonl`: an episode's score.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs)] // As in `EpisodeScore`.
pub struct ScoreLine {
    /// Gradient step of the evaluated snapshot.
    pub step: u64,
    pub seed: u64,
    #[serde(rename = "return")]
    pub episode_return: f64,
    pub length: u32,
    pub score: f64,
    /// BLAKE3 of the snapshot's file.
    pub weights: String,
    /// Arithmetic of the policy, e.g. `f32-avx2` or `bf16-amx`; empty in older lines.
    #[serde(default)]
    pub precision: String,
    pub evaluator: String,
}

impl ScoreLine {
    /// The line of an episode of a report.
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
        EpisodeScore {
            seed: self.seed,
            episode_return: self.episode_return,
            length: self.length,
            score: self.score,
        }
    }
}

/// Reads the complete lines of `metrics.jsonl` in a run folder; a missing file has none.
pub fn read_metrics(folder: &Path) -> Result<Vec<MetricsLine>, RunDirError> {
    let path = folder.join("metrics.jsonl");
    let text = files::optional(files::read_text(&path)).map_err(io_error("read", &path))?;
    let parse = |line| serde_json::from_str(line).ok();
    Ok(text.unwrap_or_default().lines().filter_map(parse).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::line;

    #[test]
    fn scores_keep_every_bit() {
        for number in (1..5_000).map(f64::from) {
            let mut line = line(1, 2, number.ln() * 13.7);
            line.episode_return = number.sqrt() * 37.0;
            let text = serde_json::to_string(&line).unwrap();
            let read: ScoreLine = serde_json::from_str(&text).unwrap();
            let bits = |line: &ScoreLine| [line.episode_return.to_bits(), line.score.to_bits()];
            assert_eq!(bits(&read), bits(&line), "{text}");
        }
    }
}
