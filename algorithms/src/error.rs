//! Errors of algorithms: hyper-parameters that cannot be used, data without examples.

use quad_policy::PolicyError;

/// Reasons for which an algorithm cannot start or be saved.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum AlgorithmError {
    #[error(transparent)]
    Policy(#[from] PolicyError),
    #[error(transparent)]
    Agent(#[from] AgentError),
    #[error("no transition of the dataset has a next action, which this algorithm learns from")]
    NoNextAction,
    #[error("no episode of the dataset has {0} transitions (agent.shortest_episode)")]
    ShortEpisodes(usize),
    #[error(
        "no episode of the dataset has {0} transitions, which this algorithm plans ahead, and none terminates"
    )]
    NoWindow(usize),
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
                "a shorter horizon (--agent network.horizon=8, say), or longer episodes"
            }
            Self::Policy(_) | Self::Agent(_) | Self::Candle(_) => {
                "`learner presets TASK` prints hyper-parameters that work; smaller networks and batches take less memory"
            }
        }
    }
}

/// Hyper-parameters that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)] // The messages say what each variant is.
pub enum AgentError {
    #[error("[agent]: {0}")]
    Parse(String),
    #[error("agent.{0} is {1}, but must be {2}")]
    Range(&'static str, String, &'static str),
    #[error(
        "{0} learns single actions from single observations, so agent.chunk and agent.history must be 1"
    )]
    NoChunks(&'static str),
}

impl From<toml::de::Error> for AgentError {
    fn from(error: toml::de::Error) -> Self {
        Self::Parse(in_words(&error))
    }
}

/// The message of a TOML parser, with words for the types of Rust and serde.
pub fn in_words(error: &toml::de::Error) -> String {
    let mut message = error.to_string();
    for (types, words) in [
        (&["u64", "usize"][..], "a whole number from 0"),
        (&["u8"], "a whole number from 0 to 255"),
        (&["u32"], "a whole number from 0 to 4294967295"),
        (&["f32", "f64"], "a number"),
        (&["a sequence"], "a list"),
        (&["a map", "struct Online"], "a table"),
        (&["string only"], "a string"),
    ] {
        for name in types {
            message =
                message.replace(&format!("expected {name}\n"), &format!("expected {words}\n"));
        }
    }
    message.trim_end().to_owned()
}

/// Checks that a hyper-parameter is in its range.
pub(super) fn check(
    field: &'static str,
    value: impl ToString,
    holds: bool,
    range: &'static str,
) -> Result<(), AgentError> {
    match holds {
        true => Ok(()),
        false => Err(AgentError::Range(field, value.to_string(), range)),
    }
}
