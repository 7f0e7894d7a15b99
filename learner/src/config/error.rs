//! What can be wrong with a preset, and what to do about it.

use std::path::PathBuf;

use crate::algorithms::{ALGORITHMS, AgentError};
use crate::presets;

/// A preset that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read the preset {path}")]
    Read {
        /// Where it should be.
        path: PathBuf,
        /// What the system says.
        source: std::io::Error,
    },
    /// Neither embedded nor a path.
    #[error("there is no preset named {0}")]
    Unknown(String),
    /// Good for others to build on, but nothing to train.
    #[error("preset {0} names no environment: others build on it")]
    Base(String),
    /// Not TOML, a field too few, or a wrong type.
    #[error("preset {preset}: {source}")]
    Parse {
        /// Which preset.
        preset: String,
        /// What is wrong, with the line if it is not TOML.
        source: Box<toml::de::Error>,
    },
    /// A key that means nothing.
    #[error("there is nothing to set by the name {key}")]
    Key {
        /// The key, dotted.
        key: String,
        /// Keys that are most like it.
        nearest: Vec<String>,
    },
    /// An algorithm that nobody knows.
    #[error("there is no algorithm named {0:?}; there are {known}", known = ALGORITHMS.map(|known| known.name).join(", "))]
    Algorithm(String),
    /// A hyper-parameter that the algorithm does not have, or one outside its range.
    #[error("algorithm {algorithm}: {source}")]
    Agent {
        /// Which algorithm.
        algorithm: String,
        /// What is wrong.
        source: AgentError,
    },
    /// Candidates for a policy that samples none.
    #[error("candidates is {0}, but the policy of this algorithm does not sample any, so it must be 1")]
    Candidates(u32),
    /// Another value outside its range.
    #[error("{field} is {value}, but must be from {least} to {most}")]
    Range {
        /// Name of the field.
        field: &'static str,
        /// What it was.
        value: u64,
        /// Smallest allowed.
        least: u64,
        /// Largest allowed.
        most: u64,
    },
}

impl ConfigError {
    /// What to do about it.
    pub fn hint(&self) -> Option<String> {
        const LIST: &str = "`learner presets` lists them all";
        match self {
            Self::Unknown(preset) => match presets::nearest(preset, presets::names())[..] {
                [] => Some(LIST.to_owned()),
                ref nearest => Some(format!("did you mean {}? {LIST}", nearest.join(", "))),
            },
            Self::Base(_) => Some("`learner presets` lists those that can be trained".to_owned()),
            Self::Key { nearest, .. } if nearest.is_empty() => {
                Some("`learner presets NAME` shows every key of a preset".to_owned())
            }
            Self::Key { nearest, .. } => Some(format!("did you mean {}?", nearest.join(", "))),
            _ => None,
        }
    }
}
