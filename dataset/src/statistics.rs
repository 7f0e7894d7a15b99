//! Figures that describe a dataset.

use crate::EnvironmentSpec;

/// How much a dataset holds and how good its behaviour is, from the recorded rewards.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Statistics {
    /// Transitions to learn from.
    pub transitions: usize,
    /// Recorded episodes; one that the end of the file cuts off counts as well.
    pub episodes: usize,
    /// Mean undiscounted return of the episodes, every recorded row included.
    pub return_mean: f64,
    /// Smallest return.
    pub return_min: f64,
    /// Largest return.
    pub return_max: f64,
    /// Mean normalised score of the episodes ([`EnvironmentSpec::normalised_score`]), where there are reference returns.
    pub score_mean: Option<f64>,
}

impl Statistics {
    pub(crate) fn new(environment: Option<&EnvironmentSpec>, transitions: usize, returns: &[f64]) -> Self {
        let return_mean = returns.iter().sum::<f64>() / returns.len() as f64;
        Self {
            transitions,
            episodes: returns.len(),
            return_mean,
            return_min: returns.iter().copied().fold(f64::INFINITY, f64::min),
            return_max: returns.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            // The score is linear in the return, so this is the mean of the scores too.
            score_mean: environment.map(|environment| environment.normalised_score(return_mean)),
        }
    }
}

/// Sums of rewards up to each end, given (reward, whether the run ends here) in order. What follows the last end is a run too.
pub(crate) fn returns(rewards: impl Iterator<Item = (f32, bool)>) -> Vec<f64> {
    let mut finished = Vec::new();
    let mut open = None;
    for (reward, ends) in rewards {
        let sum = open.take().unwrap_or(0.0) + f64::from(reward);
        if ends {
            finished.push(sum);
        } else {
            open = Some(sum);
        }
    }
    finished.extend(open);
    finished
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn returns_are_cut_at_ends_and_the_rest_counts() {
        let rows = [(1.0, false), (2.0, true), (4.0, true), (8.0, false), (16.0, false)];
        assert_eq!(returns(rows.into_iter()), [3.0, 4.0, 24.0]);
        assert_eq!(returns(rows[..3].iter().copied()), [3.0, 4.0]);
        assert!(returns(std::iter::empty()).is_empty());
    }
}
