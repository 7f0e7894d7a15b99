//! What the files of a run say: a line of each log, and where the learner is.

use quad_protocol::{EpisodeScore, ScoreReport};
use serde::{Deserialize, Serialize};

/// Where a learner can be reached: `endpoints.json`.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct RunEndpoints {
    /// Zenoh endpoints that an evaluator can connect to.
    pub zenoh: Vec<String>,
    /// Address of `/metrics`.
    pub metrics: String,
}

/// A line of `scores.jsonl`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoreLine {
    /// Gradient step of the evaluated snapshot.
    pub step: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Undiscounted return.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Environment steps.
    pub length: u32,
    /// D4RL-normalised score.
    pub score: f64,
    /// BLAKE3 of the snapshot's file.
    pub weights: String,
    /// Arithmetic that the policy was computed in, e.g. `f32-avx2` or `bf16-amx`; lines from before there was a choice do not say.
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

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn a_score_is_read_back_with_every_bit() {
        for number in 1..5_000_u32 {
            let (episode_return, score) = (f64::from(number).sqrt() * 37.0, f64::from(number).ln() * 13.7);
            let [weights, precision, evaluator] = [const { String::new() }; 3];
            let line = ScoreLine { step: 1, seed: 2, episode_return, length: 3, score, weights, precision, evaluator };
            let back: ScoreLine = serde_json::from_str(&serde_json::to_string(&line).unwrap()).unwrap();
            let bits = |line: &ScoreLine| [line.episode_return.to_bits(), line.score.to_bits()];
            assert_eq!(bits(&back), bits(&line), "{episode_return} {score}");
        }
    }
}
