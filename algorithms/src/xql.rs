//! XQL (Garg, Hejna, Geist and Ermon 2023, "Extreme Q-Learning: MaxEnt RL without Entropy"), which
//! the QUAD paper calls EQL: Gumbel regression fits V to the soft maximum of Q over actions of the
//! data, β·ln E exp(Q/β), without a sample of a policy. What its authors' scripts add for single
//! datasets is in `pairs` and `value_steps`.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/xql.rs"]
mod golden;

use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting};
use super::hyperparameters::{Count, NotNegative, Positive};
use super::in_sample::{Common, Helps, ImplicitLosses, InSample, read, scale_down, table};
use super::random::{Purpose, stream};
use candle_core::{Result, Tensor};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "xql",
    settings: include_str!("../../presets/xql.toml"),
    metrics: METRICS,
    report: Reporting::PLAIN,
    check: |table| read::<Config>(table).map(drop),
    start: |table, context| Ok(Box::new(InSample::new(read::<Config>(table)?, context)?)),
};

/// Bound of the noise on the actions that V sees.
const LARGEST_NOISE: f64 = 0.5;

const METRICS: &[Metric] = &table(Helps {
    targets: "Mean over the batch of the critics' target y = r + γ·mask·V(s').",
    value_loss: "Gumbel regression of V, mean over the batch of exp(z − M) − z·exp(−M) − exp(−M) with z = (min_k Q̂_k(s, a) − V(s))/beta, at most largest_exponent, and M = max(largest z, −1); before V's last step.",
    critic_loss: "Mean over the batch of the sum over both critics of Huber's loss of y − Q_k(s, a), linear from huber on.",
    actor_loss: "Mean over the batch of −weight·log π(a|s) with weight = exp(temperature·A), at most 100.",
    learning_rate: "The actor's learning rate; falls to 0 along a cosine unless actor_rate_decays is false.",
});

/// XQL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
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
    /// Whether the actor's learning rate falls to 0 along a cosine.
    actor_rate_decays: bool,
    /// Uniform actions per transition that V sees beside the data's.
    random_actions: u8,
    /// Standard deviation of the noise on the data's actions that V sees.
    value_noise: NotNegative,
    /// Steps of V per update.
    value_steps: Count,
}

/// The random numbers of one update.
struct Noise {
    /// Uniform in ±1, `[n·B, a]`: n = `random_actions` for each state, one after the other.
    actions: Option<Tensor>,
    /// Standard normal, `[B, a]`.
    normal: Option<Tensor>,
}

impl Config {
    fn noise(&self, context: &Context, step: u64) -> Result<Noise> {
        let mut generator = stream(context.seed, Purpose::Noise, step);
        let (b, a, device) = (context.batch_size, context.action_dim(), &context.device);
        let (n, noisy) = (usize::from(self.random_actions), *self.value_noise > 0.0);
        let uniform: Vec<f32> = (0..n * b * a).map(|_| generator.random_range(-1.0..1.0)).collect();
        let mut normal =
            || (0..b * a).map(|_| StandardNormal.sample(&mut generator)).collect::<Vec<f32>>();
        Ok(Noise {
            actions: (n > 0).then(|| Tensor::from_vec(uniform, (n * b, a), device)).transpose()?,
            normal: noisy.then(|| Tensor::from_vec(normal(), (b, a), device)).transpose()?,
        })
    }

    /// The batch's states and its actions with noise; behind these the states again, with actions
    /// at random.
    fn pairs_with(&self, batch: &Minibatch, noise: &Noise) -> Result<(Tensor, Tensor)> {
        let (mut states, mut actions) = (batch.observations.clone(), batch.actions.clone());
        if let Some(normal) = &noise.normal {
            let noise =
                (normal * f64::from(*self.value_noise))?.clamp(-LARGEST_NOISE, LARGEST_NOISE)?;
            actions = (actions + noise)?.clamp(-1.0, 1.0)?;
        }
        if let Some(random) = &noise.actions {
            let (b, o) = states.dims2()?;
            let n = usize::from(self.random_actions);
            let again = states.unsqueeze(1)?.broadcast_as((b, n, o))?.reshape((n * b, o))?;
            (states, actions) =
                (Tensor::cat(&[&states, &again], 0)?, Tensor::cat(&[&actions, random], 0)?);
        }
        Ok((states, actions))
    }
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

    /// As IQL's.
    fn weights(&self, advantages: &Tensor) -> Result<Tensor> {
        (advantages * f64::from(*self.temperature))?.exp()
    }

    /// Huber's: x²/2 up to `huber`, and on along the tangent.
    fn critic_loss(&self, q: &Tensor, targets: &Tensor) -> Result<Tensor> {
        let (error, huber) = (q.broadcast_sub(targets)?.abs()?, f64::from(*self.huber));
        let near = error.minimum(huber)?;
        ((near.sqr()? * 0.5)? + ((error - near)? * huber)?)?.sum(0)?.mean_all()
    }

    fn pairs(
        &self,
        context: &Context,
        step: u64,
        batch: &Minibatch,
    ) -> Result<Option<(Tensor, Tensor)>> {
        if self.random_actions == 0 && *self.value_noise == 0.0 {
            return Ok(None);
        }
        self.pairs_with(batch, &self.noise(context, step)?).map(Some)
    }

    fn value_steps(&self) -> u64 {
        *self.value_steps as u64
    }

    fn actor_rate_decays(&self) -> bool {
        self.actor_rate_decays
    }
}
