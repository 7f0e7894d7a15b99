//! How a preset turns recorded rewards into training rewards.

use serde::{Deserialize, Serialize};

/// What happens to the rewards of a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RewardRule {
    /// `r · 1000 / (max - min trajectory return)`: IQL's and DAC's rule for locomotion.
    Locomotion,
    /// The rewards as they were recorded.
    AsIs,
}

impl RewardRule {
    /// The factor on every reward, given the returns of the trajectories; none where their spread is zero but needed.
    pub(crate) fn scale(self, returns: &[f64]) -> Option<f64> {
        match self {
            Self::AsIs => Some(1.0),
            Self::Locomotion => {
                let max = returns.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let min = returns.iter().copied().fold(f64::INFINITY, f64::min);
                (max > min).then(|| 1000.0 / (max - min))
            }
        }
    }
}
