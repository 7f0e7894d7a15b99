//! Onestep-RL (Brandfonbrener, Whitney, Ranganath and Bruna 2021, "Offline RL Without Off-Policy
//! Evaluation"), with exponential weights, in three phases: the data's policy β is cloned, its
//! value Q^β is learned from the data's own next actions, and β is improved once. No value of the
//! improved policy is ever asked for.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/onestep.rs"]
mod golden;

use super::algorithm::{Algorithm, AlgorithmError, Loss, Measured, measured};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::gaussian::{first_half, log_density};
use super::hyperparameters::{Count, Positive, Rate, Steps, UnitInterval};
use super::parts::Parts;
use super::phases;
use super::random::{Purpose, stream};
use super::train_state::{TrainState, ensemble};
use candle_core::{DType, Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, MlpConfig, Tensors, Weighted};
use quad_policy::PolicyConfig;
use rand_distr::{Distribution, StandardNormal};
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "onestep",
    settings: include_str!("../../presets/onestep.toml"),
    metrics: METRICS,
    report: Reporting::PLAIN,
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(Onestep::new(read(table)?, context)?)),
};

/// Largest weight of an action of the data.
const MOST_WEIGHT: f64 = 100.0;
/// Bounds of log σ.
const LOG_STD: (f64, f64) = (-5.0, 0.0);

const METRICS: &[Metric] = &metrics! {
    behavior_loss ["behavior loss"] held_out: "First phase: mean over the batch of −log β(a|s).";
    critic_loss ["critic loss"] held_out: "Second phase: mean over the batch of (Q(s, a) − y)².";
    q_mean held_out: "Second phase: mean over the batch of the critic's target y = r + γ·mask·Q̂(s', a') with the data's next action a'.";
    actor_loss ["actor loss"] held_out: "Third phase: mean over the batch of −weight·log π(a|s) with weight = exp(temperature·A), at most 100.";
    advantage_mean held_out: "Third phase: mean over the batch of the advantage A = Q(s, a) − mean of Q(s, ·) over actions that β draws.";
    weight_mean held_out: "Third phase: mean over the batch of the weights in the actor's loss.";
    clipped_share held_out: "Third phase: share of the batch, 0 to 1, whose weight is clipped at 100.";
};

/// Onestep-RL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// β's hidden layers, and π's.
    behavior: MlpConfig,
    critic: MlpConfig,
    /// Discount γ.
    gamma: UnitInterval,
    /// Inverse temperature of the advantages.
    temperature: Positive,
    /// Actions of β, over which the mean of Q is the state's value.
    samples: Count,
    learning_rate: Positive,
    /// EMA rate of the target critic, which follows after every so many steps.
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

/// What an update does, and how many of its kind came before it.
enum Phase {
    Behavior(u64),
    Critic(u64),
    Policy(u64),
}

/// Onestep-RL in the middle of a run.
struct Onestep {
    config: Config,
    context: Context,
    /// The transitions to learn from.
    items: Vec<u32>,
    /// β.
    behavior: TrainState<Ensemble>,
    /// Q, and its EMA Q̂.
    critic: TrainState<Ensemble>,
    target_critic: Ensemble,
    /// π. Until its phase it is β, and its optimizer is new.
    actor: TrainState<Ensemble>,
}

impl Onestep {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let items = context.items_with_next_action();
        if items.is_empty() {
            return Err(AlgorithmError::NoNextAction);
        }
        let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
        let shape = |action_dim, layers: &MlpConfig, outputs| EnsembleShape {
            members: 1,
            observation_dim,
            action_dim,
            layers: layers.clone(),
            outputs,
        };
        // The same initial weights twice.
        let policy = || ensemble(shape(0, &config.behavior, 2 * action_dim), &context, 0);
        let (behavior, actor) = (policy()?, policy()?);
        let critic = ensemble(shape(action_dim, &config.critic, 1), &context, 1)?;
        Ok(Self {
            target_critic: critic.network.copy()?,
            behavior,
            critic,
            actor,
            items,
            config,
            context,
        })
    }

    /// The steps at which the phases begin.
    fn begins(&self) -> [u64; 3] {
        let Phases { behavior, critic, policy } = self.config.phases;
        phases::begin(self.context.total_steps, [behavior, critic, policy])
    }

    fn phase(&self, step: u64) -> Phase {
        let [_, critic, policy] = self.begins();
        match step {
            step if step < critic => Phase::Behavior(step),
            step if step < policy => Phase::Critic(step - critic),
            step => Phase::Policy(step - policy),
        }
    }

    /// The batch of some items, and its transitions.
    fn batch(&self, items: &[u32]) -> Result<(Minibatch, Vec<u32>)> {
        let rows: Vec<u32> = items.iter().map(|item| self.items[*item as usize]).collect();
        Ok((self.context.batch(&rows)?, rows))
    }

    /// Adam's step after so many others of its phase.
    fn adam(&self, steps: u64) -> AdamStep {
        AdamStep::after(steps, *self.config.learning_rate)
    }

    /// First phase: β toward the data's actions, and π with it.
    fn clone_behavior(&mut self, batch: &Minibatch, steps: u64) -> Result<Measured> {
        let loss = self.behavior_loss(batch)?;
        self.behavior.minimize(&loss.value, self.adam(steps))?;
        self.actor.network.soft_update(&self.behavior.network, 1.0)?; // all the way
        measured(&[loss])
    }

    fn behavior_loss(&self, batch: &Minibatch) -> Result<Loss> {
        let (mean, log_std) = distribution(&self.behavior.network, &batch.observations)?;
        Ok(Loss::new(
            "behavior_loss",
            log_density(&batch.actions, &mean, &log_std)?.mean_all()?.neg()?,
        ))
    }

    /// Second phase: the critic, which its target follows.
    fn evaluate_behavior(
        &mut self,
        batch: &Minibatch,
        next_actions: &Tensor,
        steps: u64,
    ) -> Result<Measured> {
        let loss = self.critic_loss(batch, next_actions)?;
        self.critic.minimize(&loss.value, self.adam(steps))?;
        if (steps + 1).is_multiple_of(*self.config.ema_every) {
            self.target_critic.soft_update(&self.critic.network, *self.config.ema_rate)?;
        }
        measured(&[loss])
    }

    /// Q(s, a) toward r + γ·Q̂(s', a'), with the action a' that the data takes next, `[B, a]`.
    fn critic_loss(&self, batch: &Minibatch, next_actions: &Tensor) -> Result<Loss> {
        let next = self.target_critic.values(&batch.next_observations, next_actions)?.squeeze(0)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        let loss =
            self.critic.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        Ok(Loss::new("critic_loss", loss).with("q_mean", targets.mean_all()?))
    }

    /// Third phase: the policy.
    fn improve(&mut self, batch: &Minibatch, noise: &Tensor, steps: u64) -> Result<Measured> {
        let loss = self.actor_loss(batch, noise)?;
        self.actor.minimize(&loss.value, self.adam(steps))?;
        measured(&[loss])
    }

    /// π toward actions of the data, the more so the better they are than β's.
    fn actor_loss(&self, batch: &Minibatch, noise: &Tensor) -> Result<Loss> {
        let q =
            self.critic.network.detach().values(&batch.observations, &batch.actions)?.squeeze(0)?;
        let advantage = (q - self.value(&batch.observations, noise)?)?;
        let weight = (&advantage * f64::from(*self.config.temperature))?.exp()?;
        let clipped = weight.gt(MOST_WEIGHT)?.to_dtype(DType::F32)?;
        let weight = weight.minimum(MOST_WEIGHT)?;
        let (mean, log_std) = distribution(&self.actor.network, &batch.observations)?;
        let loss = (&weight * log_density(&batch.actions, &mean, &log_std)?)?.mean_all()?.neg()?;
        let loss = Loss::new("actor_loss", loss).with("advantage_mean", advantage.mean_all()?);
        Ok(loss.with("weight_mean", weight.mean_all()?).with("clipped_share", clipped.mean_all()?))
    }

    /// The mean of Q(s, ·) over actions that β draws with this noise, `[B, S, a]`, also beyond ±1;
    /// `[B]`.
    fn value(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let (b, samples, a) = noise.dims3()?;
        let (mean, log_std) = distribution(&self.behavior.network.detach(), observations)?;
        let spread = noise.broadcast_mul(&log_std.exp()?.unsqueeze(1)?)?;
        let actions = spread.broadcast_add(&mean.unsqueeze(1)?)?.reshape((b * samples, a))?;
        self.critic.network.detach().values(observations, &actions)?.reshape((b, samples))?.mean(1)
    }

    /// Standard normal numbers for β's actions in an update, `[B, S, a]`.
    fn noise(&self, step: u64) -> Result<Tensor> {
        let mut generator = stream(self.context.seed, Purpose::Noise, step);
        let shape = (self.context.batch_size, *self.config.samples, self.context.action_dim());
        let numbers =
            (0..shape.0 * shape.1 * shape.2).map(|_| StandardNormal.sample(&mut generator));
        Tensor::from_vec(numbers.collect::<Vec<f32>>(), shape, &self.context.device)
    }
}

/// Mean and log σ of a policy's actions, `[n, a]` each: its network gives both, log σ through a
/// tanh that keeps it in bounds.
fn distribution(network: &Ensemble, observations: &Tensor) -> Result<(Tensor, Tensor)> {
    let out = network.state_outputs(observations)?.squeeze(0)?.tanh()?;
    let (a, half) = (out.dim(1)? / 2, (LOG_STD.1 - LOG_STD.0) / 2.0);
    Ok((out.narrow(1, 0, a)?, out.narrow(1, a, a)?.affine(half, LOG_STD.0 + half)?))
}

impl Algorithm for Onestep {
    fn items(&self, _: usize) -> usize {
        self.items.len()
    }

    fn phases(&self) -> Vec<u64> {
        self.begins().to_vec()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, rows) = self.batch(items)?;
        match self.phase(step) {
            Phase::Behavior(steps) => self.clone_behavior(&batch, steps),
            Phase::Critic(steps) => {
                self.evaluate_behavior(&batch, &self.context.next_actions(&rows)?, steps)
            }
            Phase::Policy(steps) => self.improve(&batch, &self.noise(step)?, steps),
        }
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, rows) = self.batch(items)?;
        measured(&[match self.phase(step) {
            Phase::Behavior(_) => self.behavior_loss(&batch)?,
            Phase::Critic(_) => self.critic_loss(&batch, &self.context.next_actions(&rows)?)?,
            Phase::Policy(_) => self.actor_loss(&batch, &self.noise(step)?)?,
        }])
    }

    /// Acts by the mean, which comes from the first half of the last layer.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        first_half(&self.actor.network, &self.config.behavior, &self.context)
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("behavior", &mut self.behavior)
            .trained("critic", &mut self.critic)
            .weights("target_critic", self.target_critic.weights_mut())
            .trained("actor", &mut self.actor)
    }
}
