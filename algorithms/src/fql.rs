//! FQL (Park, Li and Levine 2025, "Flow Q-Learning"): a flow clones the data, and a policy of one
//! step is distilled from it while it climbs the critics. No gradient passes through the flow's
//! steps. Its update is its authors' code's; equations are that paper's.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/fql.rs"]
mod golden;

use super::algorithm::{Algorithm, Loss, Measured, measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::denoising::normal;
use super::hyperparameters::{Candidates, Count, Positive, Rate, UnitInterval};
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::train_state::{TrainState, ensemble};
use candle_core::{Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, Gradients, MlpConfig, Tensors, Weighted};
use quad_policy::{ActorCriticShape, Aggregate, Choice, OneStepActor, PolicyConfig, Rule};
use rand::Rng;
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "fql",
    settings: include_str!("../../presets/fql.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(Fql::new(read(table)?, context)?)),
};

const CRITICS: usize = 2;

const METRICS: &[Metric] = &metrics! {
    q_mean ["Q"] held_out: "Mean over the batch of the critics' target y = r + γ·mask·(mean or smaller of Q̂_k(s', a')), where a' is the one-step policy's action, clipped.";
    critic_loss ["critic loss"] held_out: "Mean over batch and critics of (Q_k(s, a) − y)² (FQL's Eq. 3).";
    bc_loss ["BC loss"] held_out: "The flow's loss: mean over batch and dimensions of (v(s, x_t, t) − (a − x_0))² (FQL's Eq. 4).";
    distill_loss held_out: "Mean over batch and dimensions of the squared distance between the one-step policy's action, not clipped, and the flow's of the same noise (FQL's Eq. 6).";
    q_loss held_out: "−Mean over batch and critics of Q_k(s, π(s, z)), the action clipped; divided by the mean size of the mean over critics with normalize_q.";
    actor_loss ["actor loss"] held_out: "alpha·distill_loss + q_loss (FQL's Eq. 7).";
};

/// FQL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The hidden layers of the flow's velocity, and of the one-step policy.
    actor: MlpConfig,
    critic: MlpConfig,
    /// Discount γ.
    gamma: UnitInterval,
    /// Whether the critics' target takes their mean or the smaller.
    target: Aggregate,
    /// Weight α of the distance between the one-step policy and the flow.
    alpha: Positive,
    /// Whether Q is divided by its mean size in the policy's loss.
    normalize_q: bool,
    /// Euler steps of the flow.
    flow_steps: Count,
    learning_rate: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    /// Actions drawn to choose from, N_a; its authors take one.
    candidates: Candidates,
}

/// FQL in the middle of a run.
struct Fql {
    config: Config,
    context: Context,
    /// The velocity v(s, x, t), a network of s and [x, t].
    flow: TrainState<Ensemble>,
    /// The one-step policy π(s, z).
    actor: TrainState<Ensemble>,
    critics: TrainState<Ensemble>,
    target_critics: Ensemble,
}

/// The random numbers of an update.
struct Noise {
    /// Where the flow starts from, x_0, `[B, a]`, and its times t, `[B, 1]`.
    start: Tensor,
    times: Tensor,
    /// The noise of the one-step policy's actions in s and in s', `[B, a]`.
    of_policy: Tensor,
    of_targets: Tensor,
}

impl Fql {
    fn new(config: Config, context: Context) -> Result<Self> {
        let shape = shape(&config, &context);
        let of_actor = OneStepActor::shape(&shape);
        let of_flow = EnsembleShape { action_dim: of_actor.action_dim + 1, ..of_actor.clone() };
        let critics = ensemble(shape.critics(), &context, 1)?;
        Ok(Self {
            flow: ensemble(of_flow, &context, 2)?,
            actor: ensemble(of_actor, &context, 0)?,
            target_critics: critics.network.copy()?,
            critics,
            config,
            context,
        })
    }

    /// Update number `step`. All losses are those of the networks before it, and the targets follow
    /// these.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Noise) -> Result<Measured> {
        let adam = AdamStep::after(step, *self.config.learning_rate);
        let [critic_loss, bc_loss, actor_loss] = self.losses(batch, noise)?;
        let gradients = Gradients::of(&actor_loss.value)?;
        self.target_critics.soft_update(&self.critics.network, *self.config.ema_rate)?;
        self.critics.minimize(&critic_loss.value, adam)?;
        self.flow.minimize(&bc_loss.value, adam)?;
        self.actor.apply_gradients(&gradients, adam)?;
        measured(&[critic_loss, bc_loss, actor_loss])
    }

    /// Those of critics, flow and policy.
    fn losses(&self, batch: &Minibatch, noise: &Noise) -> Result<[Loss; 3]> {
        let targets = self.targets(batch, &noise.of_targets)?;
        let critic_loss =
            self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        let bc_loss = self.flow_loss(batch, noise)?;
        let [distill_loss, q_loss] = self.actor_losses(batch, &noise.of_policy)?;
        let actor_loss = ((&distill_loss * f64::from(*self.config.alpha))? + &q_loss)?;
        Ok([
            Loss::new("critic_loss", critic_loss).with("q_mean", targets.mean_all()?),
            Loss::new("bc_loss", bc_loss),
            Loss::new("actor_loss", actor_loss)
                .with("distill_loss", distill_loss)
                .with("q_loss", q_loss),
        ])
    }

    /// y = r + γ·mask·Q̂(s', π(s', z)), `[B]`.
    fn targets(&self, batch: &Minibatch, noise: &Tensor) -> Result<Tensor> {
        let actions = OneStepActor::new(self.actor.network.detach())
            .sample(&batch.next_observations, noise)?;
        let values = self.target_critics.values(&batch.next_observations, &actions)?;
        let q = match self.config.target {
            Aggregate::Mean => values.mean(0)?,
            Aggregate::Min => smaller(&values)?,
        };
        batch.target(*self.config.gamma, &q)
    }

    /// Mean of (v(s, x_t, t) − (a − x_0))², `[]`, on the straight way x_t from x_0 to a.
    fn flow_loss(&self, batch: &Minibatch, Noise { start, times, .. }: &Noise) -> Result<Tensor> {
        let velocity = (&batch.actions - start)?;
        let x = (start + velocity.broadcast_mul(times)?)?;
        let predicted = self
            .flow
            .network
            .outputs(&batch.observations, &Tensor::cat(&[&x, times], 1)?)?
            .squeeze(0)?;
        (predicted - velocity)?.sqr()?.mean_all()
    }

    /// Where the flow leads from this noise in as many Euler steps, `[B, a]`, a constant.
    fn flow_actions(&self, observations: &Tensor, noise: &Tensor) -> Result<Tensor> {
        let (flow, steps) = (self.flow.network.detach(), *self.config.flow_steps);
        let mut x = noise.clone();
        for step in 0..steps {
            let t = Tensor::full(step as f32 / steps as f32, (noise.dim(0)?, 1), noise.device())?;
            let velocity = flow.outputs(observations, &Tensor::cat(&[&x, &t], 1)?)?.squeeze(0)?;
            x = (x + (velocity / steps as f64)?)?;
        }
        x.clamp(-1f32, 1f32)
    }

    /// The one-step policy's distance to the flow, and −Q of its actions, maybe divided by its mean
    /// size; both `[]`.
    fn actor_losses(&self, batch: &Minibatch, noise: &Tensor) -> Result<[Tensor; 2]> {
        let actions = self.actor.network.outputs(&batch.observations, noise)?.squeeze(0)?;
        let distill_loss =
            (&actions - self.flow_actions(&batch.observations, noise)?)?.sqr()?.mean_all()?;
        let actions = actions.clamp(-1f32, 1f32)?;
        let q = self.critics.network.detach().values(&batch.observations, &actions)?.mean(0)?;
        let mut q_loss = q.mean_all()?.neg()?;
        if self.config.normalize_q {
            q_loss = (q_loss / q.detach().abs()?.mean_all()?)?;
        }
        Ok([distill_loss, q_loss])
    }

    fn noise(&self, step: u64) -> Result<Noise> {
        let (generator, device) =
            (&mut stream(self.context.seed, Purpose::Noise, step), &self.context.device);
        let (rows, shape) =
            (self.context.batch_size, (self.context.batch_size, self.context.action_dim()));
        Ok(Noise {
            start: normal(shape, generator, device)?,
            of_policy: normal(shape, generator, device)?,
            of_targets: normal(shape, generator, device)?,
            times: Tensor::from_vec(
                (0..rows).map(|_| generator.random::<f32>()).collect(),
                (rows, 1),
                device,
            )?,
        })
    }
}

fn shape(config: &Config, context: &Context) -> ActorCriticShape {
    ActorCriticShape {
        observation_dim: context.observation_dim(),
        action_dim: context.action_dim(),
        actor: config.actor.clone(),
        critic: config.critic.clone(),
        critics: CRITICS,
    }
}

impl Algorithm for Fql {
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        self.step(step, &batch, &noise)
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        measured(&self.losses(&self.context.batch(items)?, &self.noise(step)?)?)
    }

    /// The one-step policy, with the target critics to choose by.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let choice = Choice {
            candidates: *self.config.candidates,
            value: self.config.target,
            rule: Rule::Best,
        };
        let tensors = ActorCriticShape::tensors(&self.actor.network, &self.target_critics)?;
        Ok((PolicyConfig::OneStep { shape: shape(&self.config, &self.context), choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("actor", &mut self.actor)
            .trained("flow", &mut self.flow)
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut())
    }
}
