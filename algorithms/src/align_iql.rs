//! AlignIQL (He, Shen and Wang 2024, "AlignIQL: Policy Alignment in Implicit Q-Learning through
//! Constrained Optimization"): IQL's critics and a diffusion policy that only clones the data,
//! trained side by side. The policy is aligned with the critics when it acts: of its samples it
//! takes the one whose Q is closest to V. Equations of critics and V are IQL's; what is left out,
//! and what its authors' code does, is in docs/deviations.md.

use super::diffusion::{Denoising, Diffusion, DiffusionUpdate, Networks, Sampler, denoise};
use super::iql::expectile_loss;
use super::prelude::*;
use quad_nn::Reverse;
use quad_policy::{DiffusionPolicy, DiffusionShape};

pub(super) const DEFINITION: Definition = Definition {
    name: "align-iql",
    presets: include_str!("../../presets/align-iql.toml"),
    metrics: METRICS,
    read: |table| {
        Ok(start(read::<Config>(table)?, |config, context| config.start(Rule::Nearest, context)))
    },
    ..Definition::PLAIN
};

pub(super) const METRICS: &[Metric] = &metrics! {
    target_q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·V(s') (IQL's Eq. 6).";
    v_mean ["V"] held_out: "Mean over the batch of the value V(s) after its step.";
    value_loss ["value loss"] held_out: "Expectile loss of V: mean over the batch of |expectile − 1(u < 0)|·u² with u = min_k Q̂_k(s, a) − V(s) (IQL's Eq. 5).";
    critic_loss ["critic loss"] held_out: "Mean over critics and batch of (Q_k(s, a) − y)² (IQL's Eq. 6).";
    bc_loss ["BC loss"] held_out: "Mean over the batch of the sum over dimensions of (ε − ε_θ(a^t, s, t))². A network that always outputs 0 has the number of dimensions as its loss.";
    advantage_mean held_out: "Mean over the batch of the advantage min_k Q̂_k(s, a) − V(s): AlignIQL's policy takes the sample for which it is closest to 0.";
    learning_rate: "The actor's learning rate; falls to 0 along a cosine, and stays there online.";
};

/// The hyper-parameters of AlignIQL and of IDQL.
#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    diffusion_steps: Count,
    gamma: UnitInterval,
    /// The expectile τ of the value function.
    expectile: OpenUnit,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    value_learning_rate: Positive,
    /// Share of the learning rate by which each step shrinks the actor's weights.
    weight_decay: NotNegative,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    actor_ema_rate: Rate,
    candidates: Candidates,
}

/// AlignIQL or IDQL, which differ in the policy's rule of choice.
pub(super) struct AlignIql {
    config: Config,
    rule: Rule,
    value: TrainState<Ensemble>,
}

impl Config {
    pub(super) fn start(self, rule: Rule, context: Context) -> Result<Diffusion<AlignIql>> {
        let shape = DiffusionShape {
            actor: self.actor.clone(),
            critic: self.critic.clone(),
            value: (rule == Rule::Nearest).then(|| self.value.clone()),
            critics: TWIN,
            diffusion_steps: *self.diffusion_steps,
            reverse: Reverse::ClipSample,
            ..DiffusionShape::default()
        };
        Diffusion::new(shape, context, |networks, init| {
            networks.actor.decay_weights(*self.weight_decay)?;
            let value = init.value(&self.value)?;
            Ok(AlignIql { config: self, rule, value })
        })
    }
}

/// ε_θ toward the noise in the data's actions: DDPM's loss.
fn bc_loss(networks: &Networks, batch: &Batch, noise: &Denoising) -> Result<Loss> {
    let (_, predicted) = denoise(&networks.actor, batch, noise)?;
    let squares = (predicted - &noise.epsilon)?.sqr()?;
    Ok(Loss::new("bc_loss", squares.sum(1)?.mean_all()?))
}

/// The smaller Q̂(s, a), `[B]`.
fn q(networks: &Networks, batch: &Batch) -> Result<Tensor> {
    smallest(&batch.values(&networks.critic.target)?)
}

impl AlignIql {
    /// V(s) toward an expectile of the smaller Q̂(s, a), `[B]`, IQL's Eq. 5.
    fn value_loss(&self, batch: &Batch, q: &Tensor) -> Result<Loss> {
        let u = (q - state_value(&self.value, &batch.observations)?)?;
        let loss = expectile_loss(&u, *self.config.expectile)?;
        Ok(Loss::new("value_loss", loss))
    }

    /// Q(s, a) toward r + γ·V(s'), IQL's Eq. 6. Also measures V and, with the smaller Q̂(s, a), the
    /// advantage.
    fn critic_loss(&self, networks: &Networks, batch: &Batch, q: &Tensor) -> Result<Loss> {
        let value = self.value.detach();
        let next = state_value(&value, &batch.next_observations)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        let loss = batch.critic_loss(&networks.critic, &targets)?;
        let v = state_value(&value, &batch.observations)?;
        Ok(loss.with("v_mean", v.mean_all()?).with("advantage_mean", (q - v)?.mean_all()?))
    }
}

impl DiffusionUpdate for AlignIql {
    type Noise = Denoising;

    fn noise(&self, mut sampler: Sampler<'_>) -> Result<Denoising> {
        sampler.denoising()
    }

    fn begin(&mut self, networks: &mut Networks, step: u64, context: &Context) -> Result<()> {
        let config = &self.config;
        let adam = |rate: f32| AdamStep::after(step, rate);
        // IDQL's authors move only critics and V online.
        let decayed = *config.actor_learning_rate * context.decay(step, 0.0);
        self.value.set_step(adam(*config.value_learning_rate))?;
        networks.set_steps([decayed, *config.critic_learning_rate].map(adam))
    }

    fn update(
        &mut self,
        networks: &mut Networks,
        batch: &Batch,
        noise: &Denoising,
    ) -> Result<Vec<Loss>> {
        let bc_loss = bc_loss(networks, batch, noise)?;
        networks.actor.minimize_as_set(&bc_loss.value)?;
        networks.actor.soft_update(*self.config.actor_ema_rate)?;

        let q = q(networks, batch)?;
        let value_loss = self.value_loss(batch, &q)?;
        self.value.minimize_as_set(&value_loss.value)?;

        let critic_loss = self.critic_loss(networks, batch, &q)?;
        networks.critic.minimize_as_set(&critic_loss.value)?;
        networks.critic.soft_update(*self.config.ema_rate)?;
        Ok(vec![bc_loss, value_loss, critic_loss])
    }

    fn losses(&self, networks: &Networks, batch: &Batch, noise: &Denoising) -> Result<Vec<Loss>> {
        let (bc_loss, q) = (bc_loss(networks, batch, noise)?, q(networks, batch)?);
        let value_loss = self.value_loss(batch, &q)?;
        let critic_loss = self.critic_loss(networks, batch, &q)?;
        Ok(vec![bc_loss, value_loss, critic_loss])
    }

    fn measure(&self, networks: &Networks, _: &Denoising, _: &[f32]) -> Result<Measured> {
        Ok(vec![("learning_rate", networks.actor.adam.step().rate)])
    }

    /// AlignIQL takes the EMA actor's sample with the largest −(Q − V)²: the constraint Q = V of
    /// the aligned policy, as a penalty.
    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)> {
        let value = (self.rule == Rule::Nearest).then_some(&*self.value);
        let (actor, critics) = (&networks.actor.target, &networks.critic.target);
        let tensors = DiffusionPolicy::tensors(actor, Some(critics), value)?;
        let choice = Choice::new(*self.config.candidates, Aggregate::Min, self.rule);
        Ok((choice, tensors))
    }

    fn add_to<'a>(&'a mut self, dict: StateDict<'a>) -> StateDict<'a> {
        dict.with("value", &mut self.value)
    }
}
