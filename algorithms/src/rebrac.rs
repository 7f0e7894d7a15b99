//! ReBRAC (Tarasov, Kurenkov, Nikulin and Kolesnikov 2023, "Revisiting the Minimalist Approach to
//! Offline Reinforcement Learning"): TD3+BC that keeps near the data's actions in policy and
//! critics, each with its own weight. Its update is CORL's, in which its authors published it;
//! equations are that paper's.

use super::prelude::*;
use super::td3::{BcRegularizer, Common, Td3};

pub(super) const DEFINITION: Definition = Definition {
    name: "rebrac",
    presets: include_str!("../../presets/rebrac.toml"),
    metrics: METRICS,
    read: |table| {
        let start = start(read_with::<Common, Config>(table)?, Td3::new);
        Ok(Start { columns: Columns::NextActions, ..start })
    },
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &metrics! {
    target_q_mean ["Q"] held_out: "Mean over the batch of the critics' target y = r + γ·mask·(min_k Q̂_k(s', ã') − critic_penalty·Σ (ã' − a')²), where ã' is the target policy's action with noise and a' the data's next action (ReBRAC's Eq. 4); online critic_penalty is 0.";
    critic_loss ["critic loss"] held_out: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)².";
    actor_loss ["actor loss"] held_out: "Mean over the batch of actor_penalty·Σ (π(s) − a)² − λ·min_k Q_k(s, π(s)) with λ = 1/mean |min_k Q_k(s, π(s))| (ReBRAC's Eq. 5), in the policy's last step; online actor_penalty falls to online_cloning of itself.";
    bc_loss held_out: "Mean over the batch of Σ (π(s) − a)², summed over dimensions, in the policy's last step.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(flatten)]
    common: Common,
    /// Weight β₁ of the policy's squared distance to the data's actions.
    actor_penalty: NotNegative,
    /// Weight β₂ of the squared distance between next actions in the critics' target.
    critic_penalty: NotNegative,
}

impl BcRegularizer for Config {
    const FIRST: u64 = 0;
    const LAGS: bool = true;

    fn common(&self) -> &Common {
        &self.common
    }

    fn penalty(&self) -> Option<f32> {
        Some(*self.critic_penalty)
    }

    fn actor_loss(
        &self,
        actions: &Tensor,
        data: &Tensor,
        q: &Tensor,
        cloning: f64,
    ) -> Result<[Tensor; 2]> {
        let q = smallest(q)?;
        let weight = q.detach().abs()?.mean_all()?.recip()?;
        let bc_loss = (actions - data)?.sqr()?.sum(1)?.mean_all()?;
        let penalty = f64::from(*self.actor_penalty) * cloning;
        Ok([((&bc_loss * penalty)? - (q.mean_all()? * weight)?)?, bc_loss])
    }
}
