//! IQL (Kostrikov, Nair and Levine 2021, "Offline Reinforcement Learning with Implicit
//! Q-Learning"): a value function learned by expectile regression, and a Gaussian policy cloned
//! from the data with advantages as weights. Equations are that paper's.

use super::in_sample::{COSINE, Common, Helps, ImplicitLosses, InSample, table};
use super::prelude::*;

pub(super) const DEFINITION: Definition = Definition {
    name: "iql",
    presets: include_str!("../../presets/iql.toml"),
    metrics: METRICS,
    read: |table| Ok(start(read_with::<Common, Config>(table)?, InSample::new)),
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &table(Helps {
    targets: "Mean over the batch of the critics' target y = r + γ·mask·V(s') (IQL's Eq. 6).",
    value_loss: "Expectile loss of V: mean over the batch of |expectile − 1(u < 0)|·u² with u = min_k Q̂_k(s, a) − V(s) (IQL's Eq. 5).",
    critic_loss: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)² (IQL's Eq. 6).",
    actor_loss: "Mean over the batch of −weight·log π(a|s) with weight = exp(temperature·A), at most 100 (IQL's Eq. 7).",
    learning_rate: COSINE,
});

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(flatten)]
    common: Common,
    /// The expectile τ of the value function.
    expectile: OpenUnit,
    /// Inverse temperature β of the advantages.
    temperature: Positive,
}

/// Mean of |expectile − 1(u < 0)|·u² (Eq. 5), `[]`: minimal where V is Q's expectile.
pub(super) fn expectile_loss(u: &Tensor, expectile: f32) -> Result<Tensor> {
    let expectile = f64::from(expectile);
    let side = u.lt(0f32)?.to_dtype(DType::F32)?.affine(1.0 - 2.0 * expectile, expectile)?;
    (side * u.sqr()?)?.mean_all()
}

impl ImplicitLosses for Config {
    fn common(&self) -> &Common {
        &self.common
    }

    /// Eq. 5: V(s) toward an expectile.
    fn value_loss(&self, q: &Tensor, v: &Tensor) -> Result<Tensor> {
        expectile_loss(&(q - v)?, *self.expectile)
    }

    /// The weights of Eq. 7.
    fn weights(&self, advantages: &Tensor) -> Result<Tensor> {
        (advantages * f64::from(*self.temperature))?.exp()
    }
}
