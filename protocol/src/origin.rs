//! Origin of a policy's file, so that it can be scored again.

use serde::{Deserialize, Serialize};

/// Origin and evaluation of a snapshot, in the header of its file. It is a function of the run's
/// configuration, so that equal configurations make equal bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// Name of the environment.
    pub environment: String,
    /// Seed of the run, which with `step` decides the [episodes](crate::episode_seeds).
    pub seed: u64,
    /// Gradient step.
    pub step: u64,
    /// Episodes of the evaluation.
    pub episodes: u32,
}
