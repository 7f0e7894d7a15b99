//! Where a policy's file comes from, so that it can be scored again.

use serde::{Deserialize, Serialize};

/// Where a snapshot comes from, and how its run evaluates it: a part of the header in the
/// snapshot's file.
///
/// All of it is a function of the run's configuration, so runs of the same configuration make the
/// same bytes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Origin {
    /// Environment that the policy acts in.
    pub environment: String,
    /// Seed of the run, which with `step` decides the [episodes](crate::episode_seeds).
    pub seed: u64,
    /// Gradient steps so far.
    pub step: u64,
    /// Episodes of the evaluation.
    pub episodes: u32,
}
