//! Errors of algorithms: hyper-parameters that cannot be used, data without examples.

use quad_policy::PolicyError;

/// Reasons for which an algorithm cannot start or be saved.
#[derive(Debug, thiserror::Error)]
pub enum AlgorithmError {
    /// A policy or state that lacks a tensor or has one that is not finite.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// Hyper-parameters that cannot be used.
    #[error(transparent)]
    Agent(#[from] AgentError),
    /// A dataset of single transitions.
    #[error("no transition of the dataset has a next action, which this algorithm learns from")]
    NoNextAction,
    /// A dataset whose episodes are all shorter than this.
    #[error("no episode of the dataset has {0} transitions (agent.shortest_episode)")]
    ShortEpisodes(usize),
    /// A dataset without a window of this many transitions.
    #[error(
        "no episode of the dataset has {0} transitions, which this algorithm plans ahead, and none terminates"
    )]
    NoWindow(usize),
    /// A tensor that cannot be computed or moved.
    #[error("candle failed")]
    Candle(#[from] candle_core::Error),
}

impl AlgorithmError {
    /// Advice to the user.
    pub fn hint(&self) -> &'static str {
        match self {
            Self::NoNextAction => {
                "a transition has one if the next row of the file continues its episode: `learner datasets inspect` says how long \
                 episodes are; other algorithms learn from single transitions (--algorithm iql, say)"
            }
            Self::ShortEpisodes(_) => {
                "`learner datasets inspect` says how long episodes are; --agent shortest_episode=1 keeps them all"
            }
            Self::NoWindow(_) => {
                "a shorter horizon (--agent network.horizon=4, say), or longer episodes"
            }
            Self::Policy(_) | Self::Agent(_) | Self::Candle(_) => {
                "`learner presets TASK` prints hyper-parameters that work; smaller networks and batches take less memory"
            }
        }
    }
}

/// Hyper-parameters that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum AgentError {
    /// A key that is missing, unknown or of the wrong type.
    #[error("[agent]: {0}")]
    Parse(#[from] toml::de::Error),
    /// A value outside its range.
    #[error("agent.{field} is {value}, but must be {range}")]
    Range {
        /// Name within the `[agent]` table.
        field: &'static str,
        /// The value that was given.
        value: String,
        /// The values that are allowed.
        range: &'static str,
    },
}

/// Checks that a hyper-parameter is in its range.
pub(super) fn check(
    field: &'static str,
    value: impl ToString,
    holds: bool,
    range: &'static str,
) -> Result<(), AgentError> {
    if holds { Ok(()) } else { Err(AgentError::Range { field, value: value.to_string(), range }) }
}
