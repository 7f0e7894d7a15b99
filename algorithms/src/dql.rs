//! Diffusion-QL (Wang, Hunt and Zhou 2022, "Diffusion Policies as an Expressive Policy Class for
//! Offline Reinforcement Learning"): a diffusion policy that is cloned from the data and moved
//! toward actions of large Q, by the gradient through its whole reverse chain. Equations are that
//! paper's; where its authors' code does otherwise, docs/deviations.md says so.

use super::diffusion::{Denoising, Diffusion, DiffusionUpdate, Networks, Sampler, denoise};
use super::prelude::*;
use super::replay::Inputs;
use quad_nn::Reverse;
use quad_policy::{DiffusionPolicy, DiffusionShape};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

pub(super) const DEFINITION: Definition = Definition {
    name: "dql",
    presets: include_str!("../../presets/dql.toml"),
    metrics: METRICS,
    read: |table| Ok(start(read(table)?, Config::start)),
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &metrics! {
    target_q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', a'), with a' from the target actor (Diffusion-QL's Eq. 4).";
    critic_loss ["critic loss"] held_out: "Sum over both critics of the mean over the batch of (Q_k(s, a) − y)² (Diffusion-QL's Eq. 4).";
    bc_loss ["BC loss"] held_out: "Mean over batch and dimensions of (ε − ε_θ(a^t, s, t))² (Diffusion-QL's Eq. 2). A network that always outputs 0 has loss 1.";
    q_loss ["Q loss"] held_out: "−mean of Q_i(s, a⁰) over the mean of |Q_j(s, a⁰)|, where the actor samples a⁰, and chance says which critic is i and which j (Diffusion-QL's Eq. 3). While the critics are alike and Q keeps its sign over the batch it is near −1 where Q is positive, near 1 where it is negative.";
    actor_loss held_out: "(BC loss) + η·(Q loss) (Diffusion-QL's Eq. 3).";
    critic_gradient_norm: "Global norm of the critics' gradient before clipping.";
    actor_gradient_norm: "Global norm of the actor's gradient before clipping.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    diffusion_steps: Count,
    gamma: UnitInterval,
    /// Strength η of Q beside cloning.
    eta: NotNegative,
    /// Next actions sampled per next state for the target, S, of which each critic's largest value
    /// counts.
    samples: Count,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    /// Global norm at which each network's gradient is clipped.
    gradient_clip: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    actor_ema_rate: Rate,
    /// Steps between two updates of the target actor.
    actor_ema_every: Steps,
    /// First step, from 0, in which the target actor may be updated.
    actor_ema_start: u64,
    candidates: Candidates,
    /// Temperature, in units of Q, of the softmax by which the policy draws one of its candidates.
    temperature: Positive,
}

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
            critics: TWIN,
            diffusion_steps: *self.diffusion_steps,
            reverse: Reverse::Posterior,
            ..DiffusionShape::default()
        };
        Diffusion::new(shape, context, |_, _| Ok(self))
    }

    /// y of Eq. 4, `[B]`: of several next actions each critic takes its best, then the smaller of
    /// the critics counts.
    fn targets(&self, networks: &Networks, batch: &Batch, noise: &Tensor) -> Result<Tensor> {
        let next_actions = networks.sample_next(batch, noise)?;
        let q = batch.next_values(&networks.critic.target, &next_actions)?;
        let best = largest(&q.reshape((TWIN, (), *self.samples))?, 2)?;
        batch.target(*self.gamma, &smallest(&best)?)
    }

    /// Q(s, a) toward r + γ·min_k Q̂_k(s', a'), Eq. 4.
    fn critic_loss(&self, networks: &Networks, batch: &Batch, noise: &Noise) -> Result<Loss> {
        let targets = self.targets(networks, batch, &noise.next)?;
        let error = batch.squared_error(&networks.critic, &targets)?;
        Loss::critics((error * TWIN as f64)?, &targets)
    }

    /// The policy: cloned, Eq. 2, and moved toward what the critics value, Eq. 3.
    fn actor_loss(&self, networks: &Networks, batch: &Batch, noise: &Noise) -> Result<Loss> {
        let (_, predicted) = denoise(&networks.actor, batch, &noise.denoising)?;
        let bc_loss = squared_error(&predicted, &noise.denoising.epsilon)?;
        let q_loss = q_loss(networks, batch, noise)?;
        let loss = (&bc_loss + (&q_loss * f64::from(*self.eta))?)?;
        Ok(Loss::new("actor_loss", loss).with("bc_loss", bc_loss).with("q_loss", q_loss))
    }
}

/// −E[Q_i(s, a⁰)]/E|Q_j(s, a⁰)| of actions from the whole chain, `[]`: the second term of Eq. 3,
/// without η. Its gradient reaches the actor alone, and not by way of the divisor.
fn q_loss(networks: &Networks, batch: &Batch, noise: &Noise) -> Result<Tensor> {
    let actions = networks.actor.sample_with_gradient(&batch.observations, &noise.policy)?;
    let q = batch.values_at(&networks.critic.detach(), &actions)?;
    let q = q.index_select(&noise.raised, 0)?;
    let (raised, other) = (q.get(0)?, q.get(1)?);
    raised.mean_all()?.neg()? / other.abs()?.mean_all()?.detach()
}

impl DiffusionUpdate for Config {
    type Noise = Noise;

    fn noise(&self, mut sampler: Sampler<'_>) -> Result<Noise> {
        let next = sampler.chain("next_noise", *self.samples)?;
        let policy = sampler.chain("policy_noise", 1)?;
        let denoising = sampler.denoising()?;
        let first = |generator: &mut ChaCha8Rng| Ok(vec![generator.random_range(0..TWIN) as u32]);
        let first = sampler.random.vector("first_critic", first)?[0];
        let raised = Tensor::new(&[first, 1 - first], &Device::Cpu)?;
        Ok(Noise { next, policy, denoising, raised })
    }

    fn begin(&mut self, networks: &mut Networks, step: u64, _: &Context) -> Result<()> {
        let adam = |rate: Positive| AdamStep::after(step, *rate).clipped(*self.gradient_clip);
        networks.set_steps([self.actor_learning_rate, self.critic_learning_rate].map(adam))
    }

    /// Algorithm 1's loop, but for the target actor.
    fn update(
        &mut self,
        networks: &mut Networks,
        batch: &Batch,
        noise: &Noise,
    ) -> Result<Vec<Loss>> {
        let critic_loss = self.critic_loss(networks, batch, noise)?;
        let critic_norm = networks.critic.minimize_as_set(&critic_loss.value)?;
        let actor_loss = self.actor_loss(networks, batch, noise)?;
        let actor_norm = networks.actor.minimize_as_set(&actor_loss.value)?;
        networks.critic.soft_update(*self.ema_rate)?;
        Ok(vec![
            critic_loss.with("critic_gradient_norm", critic_norm),
            actor_loss.with("actor_gradient_norm", actor_norm),
        ])
    }

    fn losses(&self, networks: &Networks, batch: &Batch, noise: &Noise) -> Result<Vec<Loss>> {
        let critic_loss = self.critic_loss(networks, batch, noise)?;
        Ok(vec![critic_loss, self.actor_loss(networks, batch, noise)?])
    }

    fn end(&mut self, networks: &mut Networks, step: u64) -> Result<()> {
        if step.is_multiple_of(*self.actor_ema_every) && step >= self.actor_ema_start {
            networks.actor.soft_update(*self.actor_ema_rate)?;
        }
        Ok(())
    }

    /// The actor itself, not its EMA, which draws one of its candidates by the target critics' values.
    fn policy(&self, networks: &Networks) -> Result<(Choice, Tensors)> {
        let critics = Some(&networks.critic.target);
        let tensors = DiffusionPolicy::tensors(&networks.actor, critics, None)?;
        let rule = Rule::softmax(*self.temperature);
        Ok((Choice::new(*self.candidates, Aggregate::Min, rule), tensors))
    }
}
