//! Diffusion-QL (Wang, Hunt and Zhou 2022, "Diffusion Policies as an Expressive Policy Class for
//! Offline Reinforcement Learning"): a diffusion policy that is cloned from the data and moved
//! toward actions of large Q, by the gradient through its whole reverse chain. Equations are that
//! paper's; where its authors' code does otherwise, docs/deviations.md says so.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/dql.rs"]
mod golden;

use super::algorithm::{Loss, largest, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::denoising::Denoising;
use super::diffusion::{Diffusion, DiffusionUpdate, Networks};
use super::hyperparameters::{Candidates, Count, NotNegative, Positive, Rate, Steps, UnitInterval};
use super::replay::{Computed, Inputs};
use candle_core::{Device, Result, Tensor};
use candle_nn::loss::mse;
use quad_nn::{AdamStep, MlpConfig, Reverse, Tensors, Weighted};
use quad_policy::{Aggregate, Choice, DiffusionPolicy, DiffusionShape, Rule};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "dql",
    settings: include_str!("../../presets/dql.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(read::<Config>(table)?.start(context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;

const METRICS: &[Metric] = &metrics! {
    q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', a'), with a' from the target actor (Diffusion-QL's Eq. 4).";
    critic_loss ["critic loss"] held_out: "Sum over both critics of the mean over the batch of (Q_k(s, a) − y)² (Diffusion-QL's Eq. 4).";
    bc_loss ["BC loss"] held_out: "Mean over batch and dimensions of (ε − ε_θ(a^t, s, t))² (Diffusion-QL's Eq. 2). A network that always outputs 0 has loss 1.";
    q_loss ["Q loss"] held_out: "−mean of Q_i(s, a⁰) over the mean of |Q_j(s, a⁰)|, where the actor samples a⁰, and chance says which critic is i and which j (Diffusion-QL's Eq. 3). While the critics are alike and Q keeps its sign over the batch it is near −1 where Q is positive, near 1 where it is negative.";
    actor_loss held_out: "(BC loss) + η·(Q loss) (Diffusion-QL's Eq. 3).";
    critic_gradient_norm: "Global norm of the critics' gradient before clipping.";
    actor_gradient_norm: "Global norm of the actor's gradient before clipping.";
};

/// Diffusion-QL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    /// Denoising steps T.
    diffusion_steps: Count,
    /// Discount γ.
    gamma: UnitInterval,
    /// Strength η of Q beside cloning.
    eta: NotNegative,
    /// Next actions sampled per next state for the target, S; of several, each critic's largest
    /// value counts.
    samples: Count,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    /// Global norm at which each network's gradient is clipped.
    gradient_clip: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    /// EMA rate of the target actor.
    actor_ema_rate: Rate,
    /// The target actor follows in updates whose number, from 0, is a multiple of this …
    actor_ema_every: Steps,
    /// … and at least this.
    actor_ema_start: u64,
    /// Actions that an evaluated policy draws in each state.
    candidates: Candidates,
    /// Temperature of the softmax by which one of them is drawn, in units of Q.
    temperature: Positive,
}

/// The random numbers of one update.
#[derive(Clone)]
struct Noise {
    /// Noise of the sampled next actions, `[T, B·S, a]`.
    next: Tensor,
    /// Noise of the actions that are moved toward large Q, `[T, B, a]`.
    policy: Tensor,
    /// i and ε of Eq. 2.
    denoising: Denoising,
    /// i and j of Eq. 3, `[2]`: the critic whose value the actor raises, and the other.
    raised: Tensor,
}

impl Inputs for Noise {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let mut tensors = self.denoising.tensors();
        tensors.extend([&mut self.next, &mut self.policy, &mut self.raised]);
        tensors
    }
}

impl Config {
    fn start(self, context: Context) -> Result<Diffusion<Self>> {
        let shape = DiffusionShape {
            actor: self.actor.clone(),
            critic: self.critic.clone(),
            critics: CRITICS,
            diffusion_steps: *self.diffusion_steps,
            reverse: Reverse::Posterior,
            ..DiffusionShape::default()
        };
        Ok(Diffusion::new(Networks::new(shape, 0.0, context)?, self))
    }

    /// y of Eq. 4, `[B]`: of several next actions each critic takes its best, then the smaller of
    /// the critics counts.
    fn targets(&self, networks: &Networks, batch: &Minibatch, noise: &Tensor) -> Result<Tensor> {
        let next_actions = networks.target_actor.sample(&batch.next_observations, noise)?;
        let q = networks.target_critics.values(&batch.next_observations, &next_actions)?;
        let best = largest(&q.reshape((CRITICS, (), *self.samples))?, 2)?;
        batch.target(*self.gamma, &smaller(&best)?)
    }

    /// Q(s, a) toward r + γ·min_k Q̂_k(s', a'), Eq. 4.
    fn critic_loss(&self, networks: &Networks, batch: &Minibatch, noise: &Noise) -> Result<Loss> {
        let targets = self.targets(networks, batch, &noise.next)?;
        let error = networks.critics.network.squared_error(
            &batch.observations,
            &batch.actions,
            &targets,
        )?;
        Ok(Loss::new("critic_loss", (error * CRITICS as f64)?).with("q_mean", targets.mean_all()?))
    }

    /// The policy: cloned, Eq. 2, and moved toward what the critics value, Eq. 3.
    fn actor_loss(&self, networks: &Networks, batch: &Minibatch, noise: &Noise) -> Result<Loss> {
        let (_, predicted) = networks.denoise(batch, &noise.denoising)?;
        let bc_loss = mse(&predicted, &noise.denoising.epsilon)?;
        let q_loss = q_loss(networks, batch, noise)?;
        let loss = (&bc_loss + (&q_loss * f64::from(*self.eta))?)?;
        Ok(Loss::new("actor_loss", loss).with("bc_loss", bc_loss).with("q_loss", q_loss))
    }
}

/// −E[Q_i(s, a⁰)]/E|Q_j(s, a⁰)| of actions from the whole chain, `[]`: the second term of Eq. 3,
/// without η. Its gradient reaches the actor alone, and not by way of the divisor.
fn q_loss(networks: &Networks, batch: &Minibatch, noise: &Noise) -> Result<Tensor> {
    let actions =
        networks.actor.network.sample_with_gradient(&batch.observations, &noise.policy)?;
    let q = networks.critics.network.detach().values(&batch.observations, &actions)?;
    let q = q.index_select(&noise.raised, 0)?;
    let (raised, other) = (q.get(0)?, q.get(1)?);
    raised.mean_all()?.neg()? / other.abs()?.mean_all()?.detach()
}

impl DiffusionUpdate for Config {
    type Noise = Noise;

    fn noise(&self, networks: &Networks, generator: &mut ChaCha8Rng) -> Result<Noise> {
        let next = networks.chain_noise(*self.samples, generator)?;
        let policy = networks.chain_noise(1, generator)?;
        let denoising = networks.denoising(generator)?;
        let raised = generator.random_range(0..CRITICS) as u32;
        Ok(Noise {
            next,
            policy,
            denoising,
            raised: Tensor::new(&[raised, 1 - raised], &Device::Cpu)?,
        })
    }

    fn begin(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        let adam = |rate: f32| AdamStep { rate, clip: Some(*self.gradient_clip), count: step + 1 };
        networks.critics.adam.set(adam(*self.critic_learning_rate))?;
        networks.actor.adam.set(adam(*self.actor_learning_rate))
    }

    /// One pass through Algorithm 1's loop, but for the target actor.
    fn work(
        &mut self,
        networks: &mut Networks,
        batch: &Minibatch,
        noise: &Noise,
    ) -> Result<Computed> {
        let critic_loss = self.critic_loss(networks, batch, noise)?;
        let critic_norm = networks.critics.apply_as_set(&critic_loss.value)?;
        let actor_loss = self.actor_loss(networks, batch, noise)?;
        let actor_norm = networks.actor.apply_as_set(&actor_loss.value)?;
        networks.target_critics.soft_update(&networks.critics.network, *self.ema_rate)?;
        let critic_loss = critic_loss.with("critic_gradient_norm", critic_norm);
        Computed::new(&[critic_loss, actor_loss.with("actor_gradient_norm", actor_norm)], &[])
    }

    fn evaluate(&self, networks: &Networks, batch: &Minibatch, noise: &Noise) -> Result<Computed> {
        let critic_loss = self.critic_loss(networks, batch, noise)?;
        Computed::new(&[critic_loss, self.actor_loss(networks, batch, noise)?], &[])
    }

    fn end(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        if step.is_multiple_of(*self.actor_ema_every) && step >= self.actor_ema_start {
            networks.target_actor.soft_update(&networks.actor.network, *self.actor_ema_rate)?;
        }
        Ok(())
    }

    /// The actor as it is, not its EMA; one of its candidates is drawn by what the target critics
    /// say of them.
    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)> {
        let tensors =
            DiffusionPolicy::tensors(&networks.actor.network, &networks.target_critics, None)?;
        let rule = Rule::Softmax { temperature: *self.temperature };
        Ok((Choice { candidates: *self.candidates, value: Aggregate::Min, rule }, tensors))
    }
}
