//! What is known of an environment without simulating it: sizes, time limit, and the returns that score 0 and 100.

/// Sizes and reference returns of one environment (D4RL's locomotion-v2 semantics).
#[derive(Debug, PartialEq)]
pub struct EnvironmentSpec {
    /// Name used on command lines, in presets and on the wire.
    pub name: &'static str,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action, each within ±1.
    pub action_dim: usize,
    /// Numbers in MuJoCo's `qpos`.
    pub qpos_dim: usize,
    /// Numbers in MuJoCo's `qvel`.
    pub qvel_dim: usize,
    /// Steps after which an episode is cut off (a timeout, not a termination).
    pub max_episode_steps: usize,
    /// Undiscounted return that scores 0 (D4RL's random policy).
    pub min_return: f64,
    /// Undiscounted return that scores 100 (D4RL's expert).
    pub max_return: f64,
}

static ENVIRONMENTS: [EnvironmentSpec; 1] = [EnvironmentSpec {
    name: "hopper",
    observation_dim: 11,
    action_dim: 3,
    qpos_dim: 6,
    qvel_dim: 6,
    max_episode_steps: 1000,
    min_return: -20.272305,
    max_return: 3234.3,
}];

/// The name of no environment.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("unknown environment `{name}`; known: {}", ENVIRONMENTS.iter().map(|e| e.name).collect::<Vec<_>>().join(", "))]
pub struct UnknownEnvironment {
    /// What was asked for.
    pub name: String,
}

/// The environment of that name.
pub fn find(name: &str) -> Result<&'static EnvironmentSpec, UnknownEnvironment> {
    ENVIRONMENTS
        .iter()
        .find(|environment| environment.name == name)
        .ok_or_else(|| UnknownEnvironment { name: name.to_owned() })
}

impl EnvironmentSpec {
    /// D4RL's normalised score of an undiscounted return: `100 · (R - min) / (max - min)`.
    pub fn normalised_score(&self, episode_return: f64) -> f64 {
        100.0 * (episode_return - self.min_return) / (self.max_return - self.min_return)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn references_score_zero_and_a_hundred() {
        let hopper = find("hopper").unwrap();
        assert_eq!(hopper.normalised_score(-20.272305), 0.0);
        assert_eq!(hopper.normalised_score(3234.3), 100.0);
        assert!((hopper.normalised_score(1607.0138475) - 50.0).abs() < 1e-9);
    }

    #[test]
    fn an_unknown_name_is_answered_with_the_known_ones() {
        let error = find("Hopper-v2").unwrap_err();
        assert_eq!(error.to_string(), "unknown environment `Hopper-v2`; known: hopper");
    }
}
