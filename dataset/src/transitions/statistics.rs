//! Figures that describe a dataset.

use crate::statistics::{Episode, Extent};
use crate::tables::environment::EnvironmentSpec;

/// How much a dataset holds and how good its behavior is, from the recorded rewards.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Transitions to learn from.
    pub transitions: usize,
    /// Recorded episodes; one that the end of the file cuts off counts as well.
    pub episodes: usize,
    /// Mean undiscounted return of the episodes, every recorded step included. Where the task is to
    /// reach a goal, the steps after it do not count, as an evaluation would end there.
    pub return_mean: f64,
    /// Smallest return.
    pub return_min: f64,
    /// Largest return.
    pub return_max: f64,
    /// Mean normalized score of the episodes ([`EnvironmentSpec::normalized_score`]), where there
    /// are reference returns.
    pub score_mean: Option<f64>,
}

impl Statistics {
    pub(super) fn new(
        environment: Option<&EnvironmentSpec>,
        transitions: usize,
        episodes: &[Episode],
    ) -> Self {
        let returns = Extent::of(episodes.iter().map(|episode| episode.sum));
        Self {
            transitions,
            episodes: episodes.len(),
            return_mean: returns.mean,
            return_min: returns.min,
            return_max: returns.max,
            // The score is linear in the return, so this is the mean of the scores too.
            score_mean: environment.map(|environment| environment.normalized_score(returns.mean)),
        }
    }
}
