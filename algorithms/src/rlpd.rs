//! RLPD (Ball, Smith, Kostrikov and Levine 2023, "Efficient Online Reinforcement Learning with
//! Offline Data"): soft actor-critic on batches that are half of the dataset, half of experience,
//! with an ensemble of critics that have layer norm, and many updates for each environment step. Its
//! presets have no steps before online learning. Its update is its authors' code's.
//!
//! SAC (Haarnoja et al. 2018, "Soft Actor-Critic Algorithms and Applications") is the same update
//! with other hyper-parameters: two critics without norm, of which the policy sees the smaller one.

use super::prelude::*;
use super::squashed::Squashed;
use quad_nn::Weights;
use quad_policy::GaussianPolicy;
use rand::seq::index::sample;

pub(super) const DEFINITION: Definition = Definition {
    name: "rlpd",
    presets: include_str!("../../presets/rlpd.toml"),
    metrics: METRICS,
    needs_data: false,
    read: |table| Ok(start(Config::read(table)?, Rlpd::new)),
    ..Definition::PLAIN
};

pub(super) const SAC: Definition =
    Definition { name: "sac", presets: include_str!("../../presets/sac.toml"), ..DEFINITION };

const METRICS: &[Metric] = &metrics! {
    target_q_mean ["Q"] held_out: "Mean over the batch of the critics' target y = r + γ·mask·(min Q̂_k(s', a') − α·log π(a'|s')) over target_critics of them, drawn in each step, with a' from the policy; without the last term if entropy_backup is false.";
    critic_loss ["critic loss"] held_out: "Mean over batch and critics of (Q_k(s, a) − y)².";
    actor_loss ["actor loss"] held_out: "Mean over the batch of α·log π(a|s) − Q(s, a) with a from the policy, where Q is all critics' mean, or their least value if actor_q is min. Measured in the policy's steps.";
    entropy ["entropy"] held_out: "−mean over the batch of log π(a|s) with a from the policy; α holds it at target_entropy·(dimensions of an action). Measured in the policy's steps.";
    alpha: "α, the weight of the entropy, before its step. Measured in the policy's steps.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    /// Ensemble size K.
    critics: Count,
    /// Size of the random critic subset in the target.
    target_critics: Count,
    gamma: UnitInterval,
    /// Reward the next action's entropy in the target.
    entropy_backup: bool,
    /// The critics' value in the policy's loss: their mean, or the least.
    actor_q: ActorQ,
    /// Weight α of the entropy at the first step.
    temperature: Positive,
    /// Entropy at which α holds the policy, for each dimension of an action.
    target_entropy: Finite,
    /// The form of α's loss.
    temperature_loss: TemperatureLoss,
    /// Learning rate of actor, critics and α.
    learning_rate: Positive,
    /// Let the learning rate fall to 0 along a cosine over the run.
    decay: bool,
    ema_rate: Rate,
    /// Steps of the critics for each step of policy and α.
    actor_every: Steps,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum ActorQ {
    Mean,
    Min,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum TemperatureLoss {
    /// α·(entropy − target).
    Alpha,
    /// log α·(entropy − target).
    Log,
}

impl Config {
    fn read(table: &toml::Table) -> std::result::Result<Self, AgentError> {
        let config: Self = read(table)?;
        let (subset, most) = (*config.target_critics, *config.critics);
        check("target_critics", subset, subset <= most, "at most agent.critics")?;
        Ok(config)
    }
}

networks! {
    struct Rlpd(config: Config, init) {
        actor: Squashed = Squashed::new(&config.actor, GaussianPolicy::LOG_STD, init),
        critic: WithTarget<Ensemble> = init.critics(*config.critics, &config.critic),
        /// log α, `[1]`.
        log_alpha: TrainState<Weights> = init.numbers("value", &[config.temperature.ln()]),
    }
}

struct Noise {
    /// Noise of the next actions in the target, `[B, 1, a]`.
    next: Tensor,
    /// Noise of the actions in the actor's loss, `[B, 1, a]`.
    policy: Tensor,
    /// Indices of the critics of the target.
    critics: Tensor,
}

impl Rlpd {
    fn noise(&self, step: u64, b: usize) -> Result<Noise> {
        let (mut random, shape) = (self.context.random(step), (b, 1, self.context.action_dim()));
        let next = random.normal("next_noise", shape)?;
        let policy = random.normal("policy_noise", shape)?;
        let critics = random.vector("target_critics", |generator| {
            let drawn = sample(generator, *self.config.critics, *self.config.target_critics);
            Ok(drawn.into_iter().map(|index| index as u32).collect())
        })?;
        Ok(Noise { next, policy, critics: Tensor::new(critics, &self.context.device)? })
    }

    /// α, `[1]`.
    fn alpha(&self) -> Result<Tensor> {
        self.log_alpha.values().detach().exp()
    }

    /// Every critic toward r + γ·mask·(min Q̂_k(s', a') − α·log π(a'|s')).
    fn critic_loss(&self, batch: &Batch, noise: &Noise) -> Result<Loss> {
        let next = self.actor.constant_distribution(&batch.next_observations)?.draw(&noise.next)?;
        let values = batch.next_values(&self.critic.target, &next.actions.squeeze(1)?)?;
        let mut q = smallest(&values.index_select(&noise.critics, 0)?)?;
        if self.config.entropy_backup {
            q = (q - next.log_density.squeeze(1)?.broadcast_mul(&self.alpha()?)?)?;
        }
        batch.critic_loss(&self.critic, &batch.target(*self.config.gamma, &q)?)
    }

    /// The policy toward large entropy and large Q; and its entropy, `[]`, a constant.
    fn actor_loss(&self, batch: &Batch, noise: &Noise) -> Result<(Loss, Tensor)> {
        let drawn = self.actor.distribution(&batch.observations)?.draw(&noise.policy)?;
        let q = batch.values_at(&self.critic.detach(), &drawn.actions.squeeze(1)?)?;
        let q = match self.config.actor_q {
            ActorQ::Mean => q.mean(0)?,
            ActorQ::Min => smallest(&q)?,
        };
        let (alpha, log_density) = (self.alpha()?, drawn.log_density.squeeze(1)?);
        let entropy = log_density.detach().mean_all()?.neg()?;
        let loss = (log_density.broadcast_mul(&alpha)? - q)?.mean_all()?;
        let loss = Loss::new("actor_loss", loss).with("entropy", entropy.clone());
        Ok((loss.with("alpha", alpha), entropy))
    }

    /// α toward less where the entropy, `[]`, is above its target.
    fn temperature_loss(&self, entropy: &Tensor) -> Result<Tensor> {
        let target = *self.config.target_entropy * self.context.action_dim() as f32;
        let log_alpha = self.log_alpha.values().sum_all()?;
        let weight = match self.config.temperature_loss {
            TemperatureLoss::Alpha => log_alpha.exp()?,
            TemperatureLoss::Log => log_alpha,
        };
        weight * (entropy - f64::from(target))?
    }
}

impl Algorithm for Rlpd {
    /// The policy learns from the last of each `actor_every` batches, after the critics.
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        let (mut rate, every) = (*self.config.learning_rate, *self.config.actor_every);
        if self.config.decay {
            rate *= cosine_decay(step, self.context.total_steps + self.context.online_steps);
        }
        let mut losses = vec![self.critic_loss(batch, &noise)?];
        self.critic.minimize(&losses[0].value, AdamStep::after(step, rate))?;
        self.critic.soft_update(*self.config.ema_rate)?;
        if (step + 1).is_multiple_of(every) {
            let (actor_loss, entropy) = self.actor_loss(batch, &noise)?;
            let adam = AdamStep::after(step / every, rate);
            self.actor.minimize(&actor_loss.value, adam)?;
            self.log_alpha.minimize(&self.temperature_loss(&entropy)?, adam)?;
            losses.push(actor_loss);
        }
        measured(&losses)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        measured(&[self.critic_loss(batch, &noise)?, self.actor_loss(batch, &noise)?.0])
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        self.actor.policy()
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks()
    }
}
