//! XQL (Garg, Hejna, Geist and Ermon 2023, "Extreme Q-Learning: MaxEnt RL without Entropy"), which
//! the QUAD paper calls EQL: Gumbel regression fits V to the soft maximum of Q over actions of the
//! data, β·ln E exp(Q/β), without a sample of a policy. What its authors' scripts add for single
//! datasets is in `pairs` and `value_steps`.

use super::in_sample::{Common, Helps, ImplicitLosses, InSample, scale_down, table};
use super::prelude::*;

pub(super) const DEFINITION: Definition = Definition {
    name: "xql",
    presets: include_str!("../../presets/xql.toml"),
    metrics: METRICS,
    read: |table| Ok(start(read_with::<Common, Config>(table)?, InSample::new)),
    ..Definition::PLAIN
};

/// Bound of the noise on the actions that V sees.
const LARGEST_NOISE: f64 = 0.5;

const METRICS: &[Metric] = &table(Helps {
    targets: "Mean over the batch of the critics' target y = r + γ·mask·V(s').",
    value_loss: "Gumbel regression of V, mean over the batch of exp(z − M) − z·exp(−M) − exp(−M) with z = (min_k Q̂_k(s, a) − V(s))/beta, at most largest_exponent, and M = max(largest z, −1); before V's last step.",
    critic_loss: "Mean over the batch of the sum over both critics of Huber's loss of y − Q_k(s, a), linear from huber on.",
    actor_loss: "Mean over the batch of −weight·log π(a|s) with weight = exp(temperature·A), at most 100.",
    learning_rate: "The actor's learning rate; falls to 0 along a cosine, and is constant online or if actor_rate_decays is false.",
});

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    #[serde(flatten)]
    common: Common,
    /// Temperature β of the Gumbel regression.
    beta: Positive,
    /// Largest (Q − V)/β.
    largest_exponent: Positive,
    /// Inverse temperature of the advantages in the policy's weights.
    temperature: Positive,
    /// Error of the critics from which their loss is linear.
    huber: Positive,
    /// Decay of the actor's learning rate to 0 along a cosine before online learning.
    actor_rate_decays: bool,
    /// Uniform actions per transition that V sees beside the data's.
    random_actions: u8,
    /// Standard deviation of the noise on the data's actions that V sees.
    value_noise: NotNegative,
    value_steps: Count,
}

impl ImplicitLosses for Config {
    fn common(&self) -> &Common {
        &self.common
    }

    /// Gumbel regression, E[exp(z) − z − 1] with z = (Q − V)/β, times exp(−M).
    fn value_loss(&self, q: &Tensor, v: &Tensor) -> Result<Tensor> {
        let z = ((q - v)? / f64::from(*self.beta))?.minimum(*self.largest_exponent)?;
        let down = scale_down(&z)?;
        (z.broadcast_add(&down)?.exp()? - (z + 1.0)?.broadcast_mul(&down.exp()?)?)?.mean_all()
    }

    fn weights(&self, advantages: &Tensor) -> Result<Tensor> {
        (advantages * f64::from(*self.temperature))?.exp()
    }

    /// Huber's: x²/2 up to `huber`, and on along the tangent.
    fn critic_loss(&self, q: &Tensor, targets: &Tensor) -> Result<Tensor> {
        let (error, huber) = (q.broadcast_sub(targets)?.abs()?, f64::from(*self.huber));
        let near = error.minimum(huber)?;
        ((near.sqr()? * 0.5)? + ((error - near)? * huber)?)?.sum(0)?.mean_all()
    }

    /// The batch's states and its actions with noise, then the states again with random actions.
    fn pairs(
        &self,
        context: &Context,
        step: u64,
        batch: &Batch,
    ) -> Result<Option<(Tensor, Tensor)>> {
        let n = usize::from(self.random_actions);
        let noise = f64::from(*self.value_noise);
        if n == 0 && noise == 0.0 {
            return Ok(None);
        }
        let (mut states, mut actions) = (batch.observations.clone(), batch.actions.clone());
        let (mut random, (b, a)) = (context.random(step), actions.dims2()?);
        let drawn = (n > 0).then(|| random.uniform("random_actions", (n * b, a), -1.0..1.0));
        if noise > 0.0 {
            let noise = (random.normal("value_noise", (b, a))? * noise)?;
            actions = (actions + noise.clamp(-LARGEST_NOISE, LARGEST_NOISE)?)?.clamp(-1.0, 1.0)?;
        }
        if let Some(drawn) = drawn.transpose()? {
            let o = states.dim(1)?;
            let again = states.unsqueeze(1)?.broadcast_as((b, n, o))?;
            states = Tensor::cat(&[&states, &again.reshape((n * b, o))?], 0)?;
            actions = Tensor::cat(&[&actions, &drawn], 0)?;
        }
        Ok(Some((states, actions)))
    }

    fn value_steps(&self) -> u64 {
        *self.value_steps as u64
    }

    fn actor_rate_decays(&self) -> bool {
        self.actor_rate_decays
    }
}
