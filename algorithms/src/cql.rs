//! CQL (Kumar, Zhou, Tucker and Levine 2020, "Conservative Q-Learning for Offline Reinforcement
//! Learning"): soft actor-critic whose critics are also pushed down at actions that the policy
//! takes and up at those of the data, so that they do not overestimate the policy's value. A run
//! online is Cal-QL, which pushes values down no further than to the data's returns.
//! Equations are that paper's; docs/deviations.md says which of several codes is followed.

use super::prelude::*;
use super::squashed::{Normal, Squashed};
use quad_nn::Weights;
use quad_policy::GaussianPolicy;

pub(super) const DEFINITION: Definition = Definition {
    name: "cql",
    presets: include_str!("../../presets/cql.toml"),
    metrics: METRICS,
    read: |table| {
        let config: Config = read(table)?;
        let columns = Columns::Returns(*config.gamma);
        Ok(Start { columns, ..start(config, Cql::new) })
    },
    ..Definition::PLAIN
};

/// Factor of the last layers' initial weights.
const LAST_LAYER: f64 = 0.01;
/// Initial log α', and the largest α'.
const LOG_ALPHA_PRIME: f32 = 1.0;
const MOST_ALPHA_PRIME: f64 = 1e6;

const METRICS: &[Metric] = &metrics! {
    target_q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', a') with a' from the policy; of several a' the best.";
    critic_loss ["critic loss"] held_out: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)² (the last term of CQL's Eq. 3).";
    gap ["gap"] held_out: "Mean over batch and critics of log Σ exp Q_k(s, ·) − Q_k(s, a), which the critics also descend (CQL's Eq. 4); below 0 where the data's action is worth more than all others together. Online the policy's actions count as worth at least the data's discounted return (Cal-QL).";
    actor_loss ["actor loss"] held_out: "Mean over the batch of α·log π(a|s) − min_k Q_k(s, a) with a from the policy; while the policy is cloned, −log π of the data's action is in the place of −min_k Q_k.";
    entropy ["entropy"] held_out: "−mean over the batch of log π(a|s) with a from the policy; α holds it at −(dimensions of an action).";
    alpha: "α, the weight of the entropy in the actor's loss, before its step.";
    alpha_prime: "α', which the weight of the gap is multiplied by, before its step; rises while the gap is above the threshold. Measured with a threshold only.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    gamma: UnitInterval,
    /// Weight of the conservative gap in the critics' loss, the paper's α.
    weight: Positive,
    /// Gap to which α' drives the critics; without it there is no α'.
    threshold: Option<Finite>,
    /// Lower bound of each state's gap.
    least_gap: Option<Finite>,
    /// Number of uniform actions, of actions of the policy at s and of those at s' in the gap, N.
    actions: Count,
    /// Next actions drawn per next state for the target; of several, the best counts.
    samples: Count,
    log_std: LogStd,
    /// Learning rate of the actor and of α.
    actor_learning_rate: Positive,
    /// Learning rate of the critics and of α'.
    critic_learning_rate: Positive,
    ema_rate: Rate,
    phases: Phases,
}

/// Initial c₁ and c₂ of log σ = c₁·x + c₂, where x is an output of the policy's network.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct LogStd {
    multiplier: Finite,
    offset: Finite,
}

/// The phases' lengths in proportion: the policy clones the data, then it follows the critics.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Phases {
    cloning: u64,
    learning: Steps,
}

impl Phases {
    fn is_cloning(&self, step: u64, total_steps: u64) -> bool {
        let [step, total, cloning, learning] =
            [step, total_steps, self.cloning, *self.learning].map(u128::from);
        step * (cloning + learning) < total * cloning
    }
}

networks! {
    struct Cql(config: Config, init) {
        actor: Squashed = Squashed::new(&config.actor, GaussianPolicy::LOG_STD, init)?.with_map(
            [*config.log_std.multiplier, *config.log_std.offset],
            LAST_LAYER,
            init,
        ),
        critic: WithTarget<Ensemble> = init
            .ensemble(EnsembleShape { members: TWIN, ..init.shape(&config.critic) })?
            .scale_last_layer(LAST_LAYER)?
            .with_target(Ensemble::copy),
        /// log α, `[1]`.
        log_alpha: TrainState<Weights> = init.numbers("value", &[0.0]),
        /// log α', `[1]`.
        log_alpha_prime: Option<TrainState<Weights>> =
            config.threshold.map(|_| init.numbers("value", &[LOG_ALPHA_PRIME])).transpose(),
    }
}

struct Noise {
    /// Noise of the action in the actor's loss, `[B, 1, a]`.
    policy: Tensor,
    /// Noise of the target's next actions, `[B, S, a]`.
    target: Tensor,
    /// Uniform actions, `[B, N, a]`.
    uniform: Tensor,
    /// Noise of the gap's actions of the policy at s' and at s, `[B, N, a]` each.
    next: Tensor,
    current: Tensor,
}

impl Cql {
    fn noise(&self, step: u64, b: usize) -> Result<Noise> {
        let (mut random, a) = (self.context.random(step), self.context.action_dim());
        let each = (b, *self.config.actions, a);
        Ok(Noise {
            uniform: random.uniform("uniform_actions", each, -1.0..1.0)?,
            policy: random.normal("policy_noise", (b, 1, a))?,
            target: random.normal("target_noise", (b, *self.config.samples, a))?,
            next: random.normal("next_noise", each)?,
            current: random.normal("current_noise", each)?,
        })
    }

    /// The policy's loss, for large Q and entropy; and the mean of its log density, `[]`, a constant.
    fn actor_loss(
        &self,
        step: u64,
        batch: &Batch,
        current: &Normal,
        noise: &Noise,
    ) -> Result<(Loss, Tensor)> {
        let drawn = current.draw(&noise.policy)?;
        let log_density = drawn.log_density.squeeze(1)?;
        let gain = match self.config.phases.is_cloning(step, self.context.total_steps) {
            true => current.log_density(&self.actions(batch)?)?,
            false => {
                let actions = drawn.actions.squeeze(1)?;
                smallest(&batch.values_at(&self.critic.detach(), &actions)?)?
            }
        };
        let alpha = self.log_alpha.values().detach().exp()?;
        let loss = (log_density.broadcast_mul(&alpha)? - gain)?.mean_all()?;
        let log_density = log_density.detach().mean_all()?;
        let loss = Loss::new("actor_loss", loss).with("entropy", log_density.neg()?);
        Ok((loss.with("alpha", alpha), log_density))
    }

    /// The critics' squared error; and the gap, `[]`, which is added to the loss: the mean of
    /// log Σ exp Q_k(s, ·) − Q_k(s, a).
    fn critic_loss(
        &self,
        batch: &Batch,
        current: &Normal,
        next: &Normal,
        noise: &Noise,
    ) -> Result<(Loss, Tensor)> {
        let targets = self.targets(batch, next, &noise.target)?;
        let (q, gaps) = self.gaps(batch, [current, next], noise)?;
        let loss = (q.broadcast_sub(&targets)?.sqr()?.mean_all()? * TWIN as f64)?;
        let (loss, gap) = (Loss::critics(loss, &targets)?, gaps.mean_all()?);
        Ok((loss.with("gap", gap.clone()), gap))
    }

    /// The data's actions, clipped in all steps of a run that clones: at ±1 the density of a
    /// squashed Gaussian has no limit.
    fn actions(&self, batch: &Batch) -> Result<Tensor> {
        match self.config.phases.cloning {
            0 => batch.actions.clamp(-1.0, 1.0),
            _ => batch.actions.clamp(-0.999, 0.999),
        }
    }

    /// y = r + γ·mask·max_a' min_k Q̂_k(s', a') over the actions drawn with this noise, `[B, S,
    /// a]`; `[B]`.
    fn targets(&self, batch: &Batch, next: &Normal, noise: &Tensor) -> Result<Tensor> {
        let actions = next.draw(noise)?.actions;
        let q = smallest(&batch.next_values(&self.critic.target, &actions.flatten(0, 1)?)?)?;
        let best = largest(&q.reshape(((), *self.config.samples))?, 1)?;
        batch.target(*self.config.gamma, &best)
    }

    /// Q_k(s, a) of the data's actions, and log Σ exp Q_k(s, ·) − Q_k(s, a): Eq. 4 with the sum
    /// over uniform actions and those of the policy at s and s', all at s, each divided by its
    /// density (appendix F); `[K, B]` each. The policy's actions count as worth at least the returns, in
    /// a run with online steps (Cal-QL).
    fn gaps(
        &self,
        batch: &Batch,
        [current, next]: [&Normal; 2],
        noise: &Noise,
    ) -> Result<(Tensor, Tensor)> {
        let (b, n, a) = noise.uniform.dims3()?;
        let [next, current] = [next.draw(&noise.next)?, current.draw(&noise.current)?];
        // [B, 1 + 3N, a]: one pass through the critics for all.
        let data = self.actions(batch)?.unsqueeze(1)?;
        let actions = [&data, &noise.uniform, &next.actions, &current.actions];
        let actions = Tensor::cat(&actions, 1)?.flatten(0, 1)?;
        let q = batch.values_at(&self.critic, &actions)?;
        let q = q.reshape((TWIN, b, 1 + 3 * n))?;
        let data = q.narrow(2, 0, 1)?.squeeze(2)?;
        let uniform = Tensor::full(-(a as f32) * 2f32.ln(), (b, n), q.device())?;
        let densities = Tensor::cat(&[&uniform, &next.log_density, &current.log_density], 1)?;
        let mut sampled = q.narrow(2, 1, 3 * n)?;
        if let Some(returns) = &batch.returns {
            let policy = sampled.narrow(2, n, 2 * n)?;
            let bounded = policy.broadcast_maximum(&returns.reshape((1, b, 1))?)?;
            sampled = Tensor::cat(&[&sampled.narrow(2, 0, n)?, &bounded], 2)?;
        }
        let corrected = sampled.broadcast_sub(&densities)?;
        let least = self.config.least_gap.map_or(f32::NEG_INFINITY, |least| *least);
        let gaps = (log_sum_exp(&corrected)? - &data)?.maximum(least)?;
        Ok((data, gaps))
    }

    /// The weight of the gap in the critics' loss, α·α' with a threshold, else α; and α'. Moves α'
    /// up a gap above the threshold (dual gradient ascent, appendix).
    fn gap_weight(&mut self, gap: &Tensor, adam: AdamStep) -> Result<(Tensor, Option<Tensor>)> {
        let weight = f64::from(*self.config.weight);
        let (Some(learned), Some(threshold)) = (&mut self.log_alpha_prime, self.config.threshold)
        else {
            return Ok(((gap.ones_like()? * weight)?, None));
        };
        let alpha_prime = learned.values().exp()?;
        let alpha_prime = alpha_prime.clamp(0.0, MOST_ALPHA_PRIME)?.sum_all()?;
        let excess = ((gap - f64::from(*threshold))? * weight)?;
        learned.minimize(&(&alpha_prime * excess)?.neg()?, adam)?;
        let alpha_prime = alpha_prime.detach();
        Ok(((&alpha_prime * weight)?, Some(alpha_prime)))
    }
}

/// log Σ exp over the last of three dimensions, which it removes.
fn log_sum_exp(x: &Tensor) -> Result<Tensor> {
    let most = x.max_keepdim(2)?.detach();
    (x.broadcast_sub(&most)?.exp()?.sum_keepdim(2)?.log()? + most)?.squeeze(2)
}

impl Algorithm for Cql {
    /// All losses are those of the networks before the update.
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        let slow = AdamStep::after(step, *self.config.actor_learning_rate);
        let fast = AdamStep::after(step, *self.config.critic_learning_rate);
        let current = self.actor.distribution(&batch.observations)?;
        let next = self.actor.constant_distribution(&batch.next_observations)?;
        let (actor_loss, log_density) = self.actor_loss(step, batch, &current, &noise)?;
        self.actor.minimize(&actor_loss.value, slow)?;
        // α holds the entropy at −(dimensions of an action).
        let excess = (log_density - self.context.action_dim() as f64)?;
        let alpha_loss = (self.log_alpha.values().sum_all()? * excess)?.neg()?;
        self.log_alpha.minimize(&alpha_loss, slow)?;

        let (critic_loss, gap) = self.critic_loss(batch, &current.detach(), &next, &noise)?;
        let (weight, alpha_prime) = self.gap_weight(&gap.detach(), fast)?;
        let conservative = ((gap * weight)? * TWIN as f64)?;
        self.critic.minimize(&(&critic_loss.value + conservative)?, fast)?;
        self.critic.soft_update(*self.config.ema_rate)?;
        measured(&[actor_loss, critic_loss.with("alpha_prime", alpha_prime)])
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        let current = self.actor.constant_distribution(&batch.observations)?;
        let next = self.actor.constant_distribution(&batch.next_observations)?;
        let (actor_loss, _) = self.actor_loss(step, batch, &current, &noise)?;
        let (critic_loss, _) = self.critic_loss(batch, &current, &next, &noise)?;
        measured(&[actor_loss, critic_loss])
    }

    /// Acts by the tanh of the mean.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        self.actor.policy()
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks()
    }
}
