//! Transformations of recorded into training rewards.

use serde::{Deserialize, Serialize};

use crate::recording::Recording;
use crate::statistics::Summary;

/// Transformation of rewards before training. Statistics and scores use the recorded rewards.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum RewardRule {
    /// `r · 1000 / (max - min trajectory return)`: IQL and DAC on locomotion. Returns of 0 and 1,
    /// as in AntMaze, give `r · 1000`.
    #[serde(rename = "locomotion")]
    Locomotion,
    /// `r`, unchanged.
    #[default]
    #[serde(rename = "as-is")]
    AsIs,
    /// `r - 1`: IQL on AntMaze, a cost of 1 per step before the goal.
    #[serde(rename = "subtract-1")]
    Subtract1,
    /// `4(r - 0.5)`: Diffusion-QL on AntMaze.
    #[serde(rename = "center-times-4")]
    CenterTimes4,
    /// `10(r - 0.5)`: CQL on AntMaze.
    #[serde(rename = "center-times-10")]
    CenterTimes10,
    /// `100r`: ReBRAC on AntMaze.
    #[serde(rename = "times-100")]
    Times100,
}

/// Affine map `(r - subtract) · times`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct RewardScaling {
    subtract: f64,
    times: f64,
}

impl Default for RewardScaling {
    fn default() -> Self {
        Self { subtract: 0.0, times: 1.0 }
    }
}

impl RewardScaling {
    /// Root mean square of the training rewards; NaN without rewards.
    pub(crate) fn rms(self, recording: &Recording) -> f64 {
        let rewards = recording.transitions().map(|row| recording.rewards[row]);
        let rewards = rewards.map(|reward| f64::from(self.apply(reward)));
        Summary::new(&Vec::from_iter(rewards.filter(|reward| reward.is_finite()))).rms
    }

    /// The training reward.
    pub(crate) fn apply(self, reward: f32) -> f32 {
        ((f64::from(reward) - self.subtract) * self.times) as f32
    }
}

impl RewardRule {
    /// The rule's map, given the trajectory returns; `None` if it divides by their range, which is 0
    /// or that of no returns.
    pub(crate) fn scaling(self, returns: &[f64]) -> Option<RewardScaling> {
        let (subtract, times) = match self {
            Self::Locomotion => {
                let Summary { min, max, .. } = Summary::new(returns);
                (0.0, 1000.0 / Some(max - min).filter(|range| *range > 0.0)?)
            }
            Self::AsIs => return Some(RewardScaling::default()),
            Self::Subtract1 => (1.0, 1.0),
            Self::CenterTimes4 => (0.5, 4.0),
            Self::CenterTimes10 => (0.5, 10.0),
            Self::Times100 => (0.0, 100.0),
        };
        Some(RewardScaling { subtract, times })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_name_says_what_its_rule_does_to_rewards_of_0_and_1() {
        // The returns range from -1 to 3.
        for (name, reward_0, reward_1) in [
            ("locomotion", 0.0, 250.0),
            ("as-is", 0.0, 1.0),
            ("subtract-1", -1.0, 0.0),
            ("center-times-4", -2.0, 2.0),
            ("center-times-10", -5.0, 5.0),
            ("times-100", 0.0, 100.0),
        ] {
            let rule: RewardRule = serde_json::from_value(name.into()).unwrap();
            let scaling = rule.scaling(&[3.0, -1.0, 0.5]).unwrap();
            assert_eq!(scaling.apply(0.0), reward_0, "{name}");
            assert_eq!(scaling.apply(1.0), reward_1, "{name}");
        }
    }
}
