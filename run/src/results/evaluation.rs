//! Summary of one evaluation: the scores of one snapshot's episodes.

use serde::Serialize;

use super::spread::Spread;
use super::statistics::mean;
use crate::config::Experiment;
use crate::folder::ScoreLine;

/// The episodes of one snapshot.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct EvaluationReport {
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Online environment steps that the gradient steps up to `step` wait for; absent in a run
    /// without any.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub environment_steps: Option<u64>,
    /// Scored episodes.
    pub episodes: usize,
    /// True if all episodes are scored.
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
    /// True if it makes its run's score: it is complete and, in an online run, of a policy that
    /// has learned online.
    pub fn counts(&self) -> bool {
        self.complete && self.environment_steps != Some(0)
    }

    /// Summarizes the episodes of the snapshot at `step`; `None` without episodes.
    pub(super) fn new(step: u64, episodes: &[&ScoreLine], experiment: &Experiment) -> Option<Self> {
        let values = |of: fn(&ScoreLine) -> f64| Vec::from_iter(episodes.iter().map(|it| of(it)));
        Some(Self {
            step,
            environment_steps: experiment.environment_steps(step),
            episodes: episodes.len(),
            complete: episodes.len() == experiment.episodes as usize,
            score: Spread::new(&values(|line| line.score))?,
            mean_return: mean(&values(|line| line.episode_return)),
            mean_length: mean(&values(|line| line.length.into())),
        })
    }
}
