//! What a run is about: an environment by its name, known here or not.

use crate::tables::environment::{self, EnvironmentSpec};

/// Where a run's data is from and where its policies act. An environment that is not in the table
/// has the sizes of its dataset, no known time limit, and no reference returns.
#[derive(Clone, Debug, PartialEq)]
pub struct Task {
    /// Name of the environment.
    pub environment: String,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action, each within ±1.
    pub action_dim: usize,
    spec: Option<&'static EnvironmentSpec>,
}

impl Task {
    /// The environment of that name, with the sizes that its dataset has.
    pub fn new(environment: &str, observation_dim: usize, action_dim: usize) -> Self {
        let spec = environment::find(environment).ok();
        Self { environment: environment.to_owned(), observation_dim, action_dim, spec }
    }

    /// Most steps in an episode, if it is known.
    pub fn max_episode_steps(&self) -> Option<usize> {
        self.spec.map(|spec| spec.max_episode_steps)
    }

    /// Whether scores are D4RL's normalized ones. Without reference returns they are the returns
    /// themselves.
    pub fn is_normalized(&self) -> bool {
        self.spec.is_some()
    }

    /// The score of an undiscounted return: normalized where there are reference returns, else the
    /// return itself.
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
        let known = Task::from(environment::find("hopper").unwrap());
        assert_eq!([-20.272305, 3234.3].map(|sum| known.score(sum)), [0.0, 100.0]);
        assert_eq!((known.max_episode_steps(), known.is_normalized()), (Some(1000), true));
        let unknown = Task::new("my-robot", 5, 2);
        assert_eq!(
            (unknown.score(3234.3), unknown.max_episode_steps(), unknown.is_normalized()),
            (3234.3, None, false)
        );
    }
}
