//! IVR (Xu et al. 2023, "Offline RL with No OOD Actions: In-Sample Learning via Implicit Value
//! Regularization"): V and Q of a problem whose reward is less what the policy's divergence from
//! the data's costs, learned from actions of the data alone. The divergence decides the variant:
//! SQL, sparse Q-learning, or EQL, exponential Q-learning. Equations are that paper's; where its
//! authors' code does something else, docs/deviations.md says what holds.

use super::in_sample::{COSINE, Common, Helps, ImplicitLosses, InSample, scale_down, table};
use super::prelude::*;

pub(super) const DEFINITION: Definition = Definition {
    name: "ivr",
    presets: include_str!("../../presets/ivr.toml"),
    metrics: METRICS,
    variant: Some(Variant {
        key: "divergence",
        called: |divergence| format!("ivr {divergence}"),
        unused: |divergence| match divergence {
            "sparse" => &["alpha.exponential"],
            _ => &["alpha.sparse"],
        },
    }),
    read: |table| Ok(start(read_with::<Common, Config>(table)?, InSample::new)),
    ..Definition::PLAIN
};

/// (q − V)/α at which EQL's exponentials are cut off.
const LARGEST_EXPONENT: f64 = 5.0;
/// Factor of 1/α in EQL's weights.
const SHARPER: f64 = 10.0;

const METRICS: &[Metric] = &table(Helps {
    targets: "Mean over the batch of the critics' target y = r + γ·mask·V(s').",
    value_loss: "Mean over the batch, with δ = min_k Q̂_k(s, a) − V(s), of 1(z > 0)·z² + V(s)/α, z = 1 + δ/2α (divergence sparse), or of exp(z − M) + exp(−M)·V(s)/α, z = min(δ/α, 5) and M = max(largest z, −1) (exponential).",
    critic_loss: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)².",
    actor_loss: "Mean over the batch of −weight·log π(a|s) with weight = A (divergence sparse) or exp(10·A/α) (exponential), between 0 and 100 (IVR's Eq. 14 and 17, with its code's factors).",
    learning_rate: COSINE,
});

/// Divergence of the policy from the data's.
#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Divergence {
    /// Neyman's χ², f(x) = x − 1: SQL.
    Sparse,
    /// Kullback and Leibler's, f(x) = ln x: EQL.
    Exponential,
}

/// The strength of regularization with each.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Alpha {
    sparse: Positive,
    exponential: Positive,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(flatten)]
    common: Common,
    divergence: Divergence,
    alpha: Alpha,
}

impl Config {
    fn alpha(&self) -> f64 {
        f64::from(match self.divergence {
            Divergence::Sparse => *self.alpha.sparse,
            Divergence::Exponential => *self.alpha.exponential,
        })
    }
}

impl ImplicitLosses for Config {
    fn common(&self) -> &Common {
        &self.common
    }

    fn value_loss(&self, q: &Tensor, v: &Tensor) -> Result<Tensor> {
        let (excess, alpha) = ((q - v)?, self.alpha());
        match self.divergence {
            // SQL: max(z, 0) is π's density over the data's, so that its mean is 1 where the
            // gradient is 0.
            Divergence::Sparse => {
                let z = excess.affine(0.5 / alpha, 1.0)?;
                (z.relu()?.sqr()? + (v / alpha)?)?.mean_all()
            }
            // EQL: exp(z) is that density; the loss is multiplied by exp(−M).
            Divergence::Exponential => {
                let z = (excess / alpha)?.minimum(LARGEST_EXPONENT)?;
                let down = scale_down(&z)?;
                (z.broadcast_add(&down)?.exp()? + v.broadcast_mul(&(down.exp()? / alpha)?)?)?
                    .mean_all()
            }
        }
    }

    /// The weights of Eq. 14 and 17, with the code's factors: SQL's is z − 1, times 2α.
    fn weights(&self, advantages: &Tensor) -> Result<Tensor> {
        match self.divergence {
            Divergence::Sparse => Ok(advantages.clone()),
            Divergence::Exponential => (advantages * (SHARPER / self.alpha()))?.exp(),
        }
    }
}
