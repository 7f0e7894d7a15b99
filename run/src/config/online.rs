//! Online learning: the episodes that evaluators play for the learner to learn from.

use serde::{Deserialize, Serialize};

use super::error::{ConfigError, check_ranges};

/// Learning from experience, after the gradient steps on the dataset alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Online {
    /// Online environment steps; 0 turns online learning off.
    #[serde(default)]
    pub steps: u64,
    /// Gradient steps for each environment step, the update-to-data ratio.
    pub updates_per_step: u32,
    /// Environment steps before the first gradient step online.
    pub warmup: u64,
    /// True if actions during warm-up are uniform in [-1, 1] in place of the policy's.
    pub uniform_warmup: bool,
    /// Share of experience in each batch, which is all without a dataset. Without a share, batches
    /// are uniform over dataset and experience together.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub share: Option<f64>,
    /// Standard deviation of the normal noise on the policy's actions, which are within [-1, 1].
    pub noise: f64,
    /// Episodes that are in play or wait while the learner learns from those before them.
    pub lag: u32,
    /// Gradient steps between two snapshots that online episodes are played with.
    pub snapshot_interval: u64,
}

impl Online {
    /// Gradient steps that may be taken with the first `rows` environment steps.
    pub fn updates_after(&self, rows: u64) -> u64 {
        rows.min(self.steps).saturating_sub(self.warmup) * u64::from(self.updates_per_step)
    }

    /// Environment steps that the first `updates` gradient steps wait for.
    pub fn rows_at(&self, updates: u64) -> u64 {
        self.warmup + updates.div_ceil(u64::from(self.updates_per_step))
    }

    /// True if online episodes are played with the policy after gradient step `step`, where online
    /// learning begins after step `begin`.
    pub fn is_snapshot(&self, begin: u64, step: u64) -> bool {
        step >= begin && (step - begin).is_multiple_of(self.snapshot_interval)
    }

    /// The newest gradient step up to `step`, at least `begin`, whose policy plays online episodes.
    pub fn newest_snapshot(&self, begin: u64, step: u64) -> u64 {
        step - (step - begin) % self.snapshot_interval
    }

    pub(super) fn check_ranges(&self) -> Result<(), ConfigError> {
        const MOST: u64 = 1_000_000_000;
        check_ranges(&[
            ("online.steps", self.steps, 0, MOST),
            ("online.updates_per_step", self.updates_per_step.into(), 1, 1000),
            ("online.lag", self.lag.into(), 1, 1000),
            ("online.snapshot_interval", self.snapshot_interval, 1, MOST),
        ])?;
        if self.warmup >= self.steps {
            let (steps, warmup) = (self.steps, self.warmup);
            return Err(ConfigError::new(
                format!(
                    "online learning of {steps} environment steps ends within its warm-up of {warmup}"
                ),
                "gradient steps begin after the warm-up: give more --online-steps, or a shorter warm-up by \
                 --set online.warmup=N",
            ));
        }
        for (field, value) in
            [("online.share", self.share.unwrap_or(1.0)), ("online.noise", self.noise)]
        {
            if !(0.0..=1.0).contains(&value) {
                return Err(ConfigError::out_of_range(field, value, "from 0 to 1"));
            }
        }
        Ok(())
    }
}
