//! One evaluation: the scores of one snapshot's episodes, summarized.

use serde::Serialize;

use super::spread::Spread;
use crate::run::ScoreLine;

/// One snapshot's episodes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvaluationReport {
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Episodes scored.
    pub episodes: usize,
    /// Whether these are all of them.
    pub complete: bool,
    /// Score over the episodes: D4RL-normalized, or the return where the environment has no
    /// reference returns.
    pub score: Spread,
    /// Mean undiscounted return.
    pub mean_return: f64,
    /// Mean length in environment steps.
    pub mean_length: f64,
}

impl EvaluationReport {
    /// The evaluation of the snapshot at `step`, of these episodes out of `expected`; none of no
    /// episodes.
    pub(super) fn of(step: u64, episodes: &[&ScoreLine], expected: u32) -> Option<Self> {
        let mean = |value: fn(&ScoreLine) -> f64| {
            episodes.iter().map(|line| value(line)).sum::<f64>() / episodes.len() as f64
        };
        let scores: Vec<_> = episodes.iter().map(|line| line.score).collect();
        Some(Self {
            step,
            episodes: episodes.len(),
            complete: episodes.len() == expected as usize,
            score: Spread::of(&scores)?,
            mean_return: mean(|line| line.episode_return),
            mean_length: mean(|line| line.length.into()),
        })
    }
}
