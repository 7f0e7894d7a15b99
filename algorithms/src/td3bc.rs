//! TD3+BC (Fujimoto and Gu 2021, "A Minimalist Approach to Offline Reinforcement Learning"): TD3
//! whose policy also stays near the data's actions. Its update is its authors' code's; equations
//! are that paper's.

use super::prelude::*;
use super::td3::{BcRegularizer, Common, Td3};

pub(super) const DEFINITION: Definition = Definition {
    name: "td3-bc",
    presets: include_str!("../../presets/td3-bc.toml"),
    metrics: METRICS,
    read: |table| Ok(start(read_with::<Common, Config>(table)?, Td3::new)),
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &metrics! {
    target_q_mean ["Q"] held_out: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', ã'), where ã' is the target policy's action with noise.";
    critic_loss ["critic loss"] held_out: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)².";
    actor_loss ["actor loss"] held_out: "−λ·mean Q_1(s, π(s)) + mean (π(s) − a)² with λ = weight/mean |Q_1(s, π(s))| (TD3+BC's Eq. 3 to 5), in the policy's last step; online the second mean falls to online_cloning of itself.";
    bc_loss held_out: "Mean over batch and dimensions of (π(s) − a)², in the policy's last step.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(flatten)]
    common: Common,
    /// Weight of Q against the distance to the data, the paper's α.
    weight: Positive,
}

impl BcRegularizer for Config {
    const FIRST: u64 = 1;
    const LAGS: bool = false;

    fn common(&self) -> &Common {
        &self.common
    }

    fn actor_loss(
        &self,
        actions: &Tensor,
        data: &Tensor,
        q: &Tensor,
        cloning: f64,
    ) -> Result<[Tensor; 2]> {
        let q = q.get(0)?;
        let weight = (q.detach().abs()?.mean_all()?.recip()? * f64::from(*self.weight))?;
        let bc_loss = (actions - data)?.sqr()?.mean_all()?;
        Ok([((&bc_loss * cloning)? - (q.mean_all()? * weight)?)?, bc_loss])
    }
}
