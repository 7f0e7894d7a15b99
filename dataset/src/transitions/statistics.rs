//! Summary statistics of a dataset.

use crate::statistics::{EpisodeReturn, Summary};
use crate::tables::environment::EnvironmentSpec;

/// Size of a dataset and quality of its behavior policy, by the recorded rewards.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Number of transitions.
    pub transitions: usize,
    /// Number of episodes, including one truncated by the end of the file.
    pub episodes: usize,
    /// Mean undiscounted return, including dropped steps but not those after a goal.
    pub return_mean: f64,
    /// Smallest return.
    pub return_min: f64,
    /// Largest return.
    pub return_max: f64,
    /// Mean [`EnvironmentSpec::normalized_score`], if reference returns are known.
    pub score_mean: Option<f64>,
}

impl Statistics {
    pub(super) fn new(
        environment: Option<&EnvironmentSpec>,
        transitions: usize,
        episodes: &[EpisodeReturn],
    ) -> Self {
        let returns = Summary::new(&Vec::from_iter(episodes.iter().map(|episode| episode.sum)));
        Self {
            transitions,
            episodes: episodes.len(),
            return_mean: returns.mean,
            return_min: returns.min,
            return_max: returns.max,
            // The score is linear in the return.
            score_mean: environment.map(|environment| environment.normalized_score(returns.mean)),
        }
    }
}
