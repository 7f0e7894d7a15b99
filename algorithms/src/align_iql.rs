//! AlignIQL (He, Shen and Wang 2024, "AlignIQL: Policy Alignment in Implicit Q-Learning through
//! Constrained Optimization"): IQL's critics and a diffusion policy that only clones the data,
//! trained side by side. The policy is aligned with the critics when it acts: of its samples it
//! takes the one whose Q is closest to V. Equations of critics and V are IQL's; what is left out,
//! and what its authors' code does, is in docs/deviations.md.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/align_iql.rs"]
pub(super) mod golden;

use super::algorithm::{Loss, Measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::denoising::Denoising;
use super::diffusion::{Diffusion, DiffusionUpdate, Networks};
use super::hyperparameters::{
    Candidates, Count, NotNegative, OpenUnit, Positive, Rate, UnitInterval,
};
use super::iql::expectile_loss;
use super::parts::Parts;
use super::replay::Computed;
use super::train_state::{TrainState, ensemble};
use candle_core::{Device, Result, Tensor};
use quad_nn::{
    AdamStep, Ensemble, EnsembleShape, MlpConfig, Reverse, Tensors, Weighted, cosine_decay,
};
use quad_policy::{Aggregate, Choice, DiffusionPolicy, DiffusionShape, Rule};
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "align-iql",
    settings: include_str!("../../presets/align-iql.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(read::<Config>(table)?.start(Rule::Nearest, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;

pub(super) const METRICS: &[Metric] = &metrics! {
    q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·V(s') (IQL's Eq. 6).";
    v_mean ["V"] held_out: "Mean over the batch of the value V(s) after its step.";
    value_loss ["value loss"] held_out: "Expectile loss of V: mean over the batch of |expectile − 1(u < 0)|·u² with u = min_k Q̂_k(s, a) − V(s) (IQL's Eq. 5).";
    critic_loss ["critic loss"] held_out: "Mean over critics and batch of (Q_k(s, a) − y)² (IQL's Eq. 6).";
    bc_loss ["BC loss"] held_out: "Mean over the batch of the sum over dimensions of (ε − ε_θ(a^t, s, t))². A network that always outputs 0 has the number of dimensions as its loss.";
    advantage_mean held_out: "Mean over the batch of the advantage min_k Q̂_k(s, a) − V(s): AlignIQL's policy takes the sample for which it is closest to 0.";
    learning_rate: "The actor's learning rate; falls to 0 along a cosine.";
};

/// The hyper-parameters of AlignIQL and of IDQL: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    /// Denoising steps T.
    diffusion_steps: Count,
    /// Discount γ.
    gamma: UnitInterval,
    /// The expectile τ of the value function.
    expectile: OpenUnit,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    value_learning_rate: Positive,
    /// What each step takes off the actor's weights, relative to them and to the learning rate.
    weight_decay: NotNegative,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    /// EMA rate of the target actor.
    actor_ema_rate: Rate,
    /// Actions that an evaluated policy draws in each state.
    candidates: Candidates,
}

/// AlignIQL, or IDQL, beside its diffusion policy and critics.
pub(super) struct AlignIql {
    config: Config,
    /// How the policy chooses.
    rule: Rule,
    /// V.
    value: TrainState<Ensemble>,
}

impl Config {
    /// The algorithm at its beginning, whose policy chooses by this rule: IDQL's by `best`.
    pub(super) fn start(self, rule: Rule, context: Context) -> Result<Diffusion<AlignIql>> {
        let shape = DiffusionShape {
            actor: self.actor.clone(),
            critic: self.critic.clone(),
            value: (rule == Rule::Nearest).then(|| self.value.clone()),
            critics: CRITICS,
            diffusion_steps: *self.diffusion_steps,
            reverse: Reverse::ClipSample,
            ..DiffusionShape::default()
        };
        let networks = Networks::new(shape, *self.weight_decay, context)?;
        let value = EnsembleShape {
            members: 1,
            action_dim: 0,
            layers: self.value.clone(),
            ..networks.shape.critics()
        };
        let value = ensemble(value, &networks.context, 2)?;
        Ok(Diffusion::new(networks, AlignIql { config: self, rule, value }))
    }
}

/// The policy: cloning, whatever the actions are worth.
fn bc_loss(networks: &Networks, batch: &Minibatch, noise: &Denoising) -> Result<Loss> {
    let (_, predicted) = networks.denoise(batch, noise)?;
    Ok(Loss::new("bc_loss", (predicted - &noise.epsilon)?.sqr()?.sum(1)?.mean_all()?))
}

impl AlignIql {
    /// V(s) toward an expectile of the smaller Q̂(s, a), `[B]`, IQL's Eq. 5.
    fn value_loss(&self, batch: &Minibatch, q: &Tensor) -> Result<Loss> {
        let u = (q - self.value.network.state_values(&batch.observations)?.squeeze(0)?)?;
        Ok(Loss::new("value_loss", expectile_loss(&u, *self.config.expectile)?))
    }

    /// Q(s, a) toward r + γ·V(s'), IQL's Eq. 6. Also measures V and, with the smaller Q̂(s, a), the
    /// advantage.
    fn critic_loss(&self, networks: &Networks, batch: &Minibatch, q: &Tensor) -> Result<Loss> {
        let value = self.value.network.detach();
        let targets = batch.target(
            *self.config.gamma,
            &value.state_values(&batch.next_observations)?.squeeze(0)?,
        )?;
        let loss = networks.critics.network.squared_error(
            &batch.observations,
            &batch.actions,
            &targets,
        )?;
        let v = value.state_values(&batch.observations)?.squeeze(0)?;
        let loss = Loss::new("critic_loss", loss).with("q_mean", targets.mean_all()?);
        Ok(loss.with("v_mean", v.mean_all()?).with("advantage_mean", (q - v)?.mean_all()?))
    }
}

impl DiffusionUpdate for AlignIql {
    type Noise = Denoising;

    fn noise(&self, networks: &Networks, generator: &mut ChaCha8Rng) -> Result<Denoising> {
        networks.denoising(generator)
    }

    fn begin(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        let (config, decay) = (&self.config, cosine_decay(step, networks.context.total_steps));
        let adam = |rate: f32| AdamStep::after(step, rate);
        networks.actor.adam.set(adam(*config.actor_learning_rate * decay))?;
        self.value.adam.set(adam(*config.value_learning_rate))?;
        networks.critics.adam.set(adam(*config.critic_learning_rate))
    }

    fn work(
        &mut self,
        networks: &mut Networks,
        batch: &Minibatch,
        noise: &Denoising,
    ) -> Result<Computed> {
        let bc_loss = bc_loss(networks, batch, noise)?;
        let Networks { actor, target_actor, .. } = networks;
        actor.apply_as_set(&bc_loss.value)?;
        target_actor.soft_update(&actor.network, *self.config.actor_ema_rate)?;

        let q = smaller(&networks.target_critics.values(&batch.observations, &batch.actions)?)?;
        let value_loss = self.value_loss(batch, &q)?;
        self.value.apply_as_set(&value_loss.value)?;

        let critic_loss = self.critic_loss(networks, batch, &q)?;
        let Networks { critics, target_critics, .. } = networks;
        critics.apply_as_set(&critic_loss.value)?;
        target_critics.soft_update(&critics.network, *self.config.ema_rate)?;
        Computed::new(&[bc_loss, value_loss, critic_loss], &[])
    }

    fn evaluate(
        &self,
        networks: &Networks,
        batch: &Minibatch,
        noise: &Denoising,
    ) -> Result<Computed> {
        let q = smaller(&networks.target_critics.values(&batch.observations, &batch.actions)?)?;
        let of_critics = [self.value_loss(batch, &q)?, self.critic_loss(networks, batch, &q)?];
        let [value_loss, critic_loss] = of_critics;
        Computed::new(&[bc_loss(networks, batch, noise)?, value_loss, critic_loss], &[])
    }

    fn measure(&self, networks: &Networks, _: &Denoising, _: &[f32]) -> Result<Measured> {
        Ok(vec![("learning_rate", networks.actor.adam.step().rate)])
    }

    /// AlignIQL takes the EMA actor's sample with the largest −(Q − V)²: the constraint Q = V of
    /// the aligned policy, as a penalty.
    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)> {
        let Networks { target_actor, target_critics, .. } = networks;
        let value = (self.rule == Rule::Nearest).then_some(&self.value.network);
        let tensors = DiffusionPolicy::tensors(target_actor, target_critics, value)?;
        Ok((
            Choice { candidates: *self.config.candidates, value: Aggregate::Min, rule: self.rule },
            tensors,
        ))
    }

    fn parts<'a>(&'a mut self, parts: Parts<'a>, _: &'a Device) -> Parts<'a> {
        parts.trained("value", &mut self.value)
    }
}
