//! Onestep-RL (Brandfonbrener, Whitney, Ranganath and Bruna 2021, "Offline RL Without Off-Policy
//! Evaluation"), with exponential weights, in three phases: the data's policy β is cloned, its
//! value Q^β is learned from the data's own next actions, and β is improved once. No value of the
//! improved policy is ever asked for.

use super::batch::asked;
use super::gaussian::{first_half_policy, log_density};
use super::in_sample::weighted;
use super::prelude::*;

pub(super) const DEFINITION: Definition = Definition {
    name: "onestep",
    presets: include_str!("../../presets/onestep.toml"),
    metrics: METRICS,
    read: |table| {
        let start = start(read(table)?, Onestep::new);
        Ok(Start { columns: Columns::NextActions, ..start })
    },
    ..Definition::PLAIN
};

/// Bounds of log σ.
const LOG_STD: (f64, f64) = (-5.0, 0.0);

const METRICS: &[Metric] = &metrics! {
    behavior_loss ["behavior loss"] held_out: "First phase: mean over the batch of −log β(a|s).";
    critic_loss ["critic loss"] held_out: "Second phase: mean over the batch of (Q(s, a) − y)².";
    target_q_mean held_out: "Second phase: mean over the batch of the critic's target y = r + γ·mask·Q̂(s', a') with the data's next action a'.";
    actor_loss ["actor loss"] held_out: "Third phase: mean over the batch of −weight·log π(a|s) with weight = exp(temperature·A), at most 100.";
    advantage_mean held_out: "Third phase: mean over the batch of the advantage A = Q(s, a) − mean of Q(s, ·) over actions that β draws.";
    weight_mean held_out: "Third phase: mean over the batch of the weights in the actor's loss.";
    clipped_share held_out: "Third phase: share of the batch, 0 to 1, whose weight is clipped at 100.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// β's hidden layers, and π's.
    behavior: MlpConfig,
    critic: MlpConfig,
    gamma: UnitInterval,
    /// Inverse temperature of the advantages.
    temperature: Positive,
    /// Actions of β over which Q is averaged to the state's value.
    samples: Count,
    learning_rate: Positive,
    /// EMA rate of the target critic, and the critic's steps per update of it.
    ema_rate: Rate,
    ema_every: Steps,
    phases: Phases,
}

/// The phases' lengths in proportion.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Phases {
    behavior: Steps,
    critic: Steps,
    policy: Steps,
}

networks! {
    struct Onestep(config: Config, init) {
        /// β.
        behavior: TrainState<Ensemble> =
            init.state_network(&config.behavior, 2 * init.context.action_dim()),
        critic: WithTarget<Ensemble> = init.critics(1, &config.critic),
        /// π, a copy of β until its own phase.
        actor: TrainState<Ensemble> = init.copy(&behavior),
    }
}

impl Onestep {
    fn first_steps(&self) -> [u64; 3] {
        let phases = self.config.phases;
        let lengths = [phases.behavior, phases.critic, phases.policy];
        first_steps(self.context.total_steps, lengths)
    }

    /// The loss of the network that learns in a phase.
    fn loss(&self, phase: usize, step: u64, batch: &Batch) -> Result<Loss> {
        match phase {
            0 => self.behavior_loss(batch),
            1 => self.critic_loss(batch),
            _ => self.actor_loss(step, batch),
        }
    }

    /// First phase: β toward the data's actions.
    fn behavior_loss(&self, batch: &Batch) -> Result<Loss> {
        let (mean, log_std) = distribution(&self.behavior, &batch.observations)?;
        let log_probability = log_density(&batch.actions, &mean, &log_std)?;
        Ok(Loss::new("behavior_loss", log_probability.mean_all()?.neg()?))
    }

    /// Second phase: Q(s, a) toward r + γ·Q̂(s', a'), with the action a' that the data takes
    /// next.
    fn critic_loss(&self, batch: &Batch) -> Result<Loss> {
        let critic = &self.critic;
        let next_actions = asked(&batch.next_actions)?;
        let next = batch.next_values(&critic.target, next_actions)?.squeeze(0)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        batch.critic_loss(critic, &targets)
    }

    /// Third phase: π toward actions of the data, the more so the better they are than β's.
    fn actor_loss(&self, step: u64, batch: &Batch) -> Result<Loss> {
        let q = batch.values(&self.critic.detach())?.squeeze(0)?;
        let advantage = (q - self.value(step, &batch.observations)?)?;
        let weight = (&advantage * f64::from(*self.config.temperature))?.exp()?;
        let (mean, log_std) = distribution(&self.actor, &batch.observations)?;
        let log_probability = log_density(&batch.actions, &mean, &log_std)?;
        Ok(weighted(&weight, &log_probability)?.with("advantage_mean", advantage.mean_all()?))
    }

    /// The mean of Q(s, ·) over actions that β draws, also beyond ±1; `[B]`.
    fn value(&self, step: u64, observations: &Tensor) -> Result<Tensor> {
        let (b, samples) = (observations.dim(0)?, *self.config.samples);
        let shape = (b, samples, self.context.action_dim());
        let noise = self.context.random(step).normal("behavior_noise", shape)?;
        let (mean, log_std) = distribution(&self.behavior.detach(), observations)?;
        let spread = noise.broadcast_mul(&log_std.exp()?.unsqueeze(1)?)?;
        let actions = spread.broadcast_add(&mean.unsqueeze(1)?)?.flatten(0, 1)?; // [B·S, a]
        let critic = self.critic.detach();
        critic.values(observations, &actions)?.reshape((b, samples))?.mean(1)
    }
}

/// Mean and log σ of a policy's actions, `[n, a]` each, from a network's output `[n, 2a]`; the tanh
/// keeps log σ in bounds.
fn distribution(network: &Ensemble, observations: &Tensor) -> Result<(Tensor, Tensor)> {
    let out = network.state_outputs(observations)?.squeeze(0)?.tanh()?;
    let (a, half) = (out.dim(1)? / 2, (LOG_STD.1 - LOG_STD.0) / 2.0);
    Ok((out.narrow(1, 0, a)?, out.narrow(1, a, a)?.affine(half, LOG_STD.0 + half)?))
}

impl Algorithm for Onestep {
    fn phases(&self) -> Vec<u64> {
        self.first_steps().to_vec()
    }

    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let (phase, steps) = phase(&self.first_steps(), step);
        let loss = self.loss(phase, step, batch)?;
        let adam = AdamStep::after(steps, *self.config.learning_rate);
        match phase {
            0 => {
                self.behavior.minimize(&loss.value, adam)?;
                self.actor.network.soft_update(&self.behavior, 1.0)?; // all the way
            }
            1 => {
                self.critic.minimize(&loss.value, adam)?;
                if (steps + 1).is_multiple_of(*self.config.ema_every) {
                    self.critic.soft_update(*self.config.ema_rate)?;
                }
            }
            _ => drop(self.actor.minimize(&loss.value, adam)?),
        }
        measured(&[loss])
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let (phase, _) = phase(&self.first_steps(), step);
        measured(&[self.loss(phase, step, batch)?])
    }

    /// Acts by the mean.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        first_half_policy(&self.actor)
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks()
    }
}
