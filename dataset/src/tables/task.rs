//! Task of a run: an environment that may be unknown.

use crate::tables::environment::{self, EnvironmentSpec};

/// Environment of a run. One that is not in the table has the dimensions of its dataset, no time
/// limit and no reference returns.
#[derive(Clone, Debug, PartialEq)]
pub struct Task {
    /// Environment name.
    pub environment: String,
    /// Dimension of an observation.
    pub observation_dim: usize,
    /// Dimension of an action; each component is within ±1.
    pub action_dim: usize,
    spec: Option<&'static EnvironmentSpec>,
}

impl Task {
    /// Environment of the given name with its dataset's dimensions.
    pub fn new(environment: &str, observation_dim: usize, action_dim: usize) -> Self {
        let spec = environment::find(environment).ok();
        Self { environment: environment.to_owned(), observation_dim, action_dim, spec }
    }

    /// Time limit in steps, if known.
    pub fn max_episode_steps(&self) -> Option<usize> {
        self.spec.map(|spec| spec.max_episode_steps)
    }

    /// True if scores are D4RL's normalized ones; without reference returns they are plain returns.
    pub fn is_normalized(&self) -> bool {
        self.spec.is_some()
    }

    /// D4RL's normalized score of an undiscounted return, or the return without reference returns.
    pub fn score(&self, episode_return: f64) -> f64 {
        self.spec.map_or(episode_return, |spec| spec.normalized_score(episode_return))
    }
}

impl From<&'static EnvironmentSpec> for Task {
    fn from(spec: &'static EnvironmentSpec) -> Self {
        Self::new(&spec.name, spec.observation_dim, spec.action_dim)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_of_an_unknown_environment_are_its_returns() {
        let hopper = Task::from(environment::find("hopper").unwrap());
        let own = Task::new("my-robot", 5, 2);
        let returns = [-20.272305, 3234.3];
        for (task, scores, limit) in [(hopper, [0.0, 100.0], Some(1000)), (own, returns, None)] {
            assert_eq!(returns.map(|sum| task.score(sum)), scores);
            assert_eq!(task.max_episode_steps(), limit);
            assert_eq!(task.is_normalized(), limit.is_some());
        }
    }
}
