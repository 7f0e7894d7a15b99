//! Diffusion Trusted Q-Learning (Chen, Wang and Zhou 2024, "Diffusion Policies creating a Trust
//! Region for Offline Reinforcement Learning"): a diffusion policy μ_φ only clones the data. How
//! badly it denoises the actions of a second policy π_θ, of one step, says how far these are from
//! the data's: inside that trust region π_θ moves toward large Q, and no chain of denoising steps
//! is ever sampled. Where the authors' code says more than their paper, docs/deviations.md has it.

use super::gaussian::log_density;
use super::iql::expectile_loss;
use super::prelude::*;
use super::random::Random;
use super::squashed::{Normal, Squashed};
use quad_nn::{Denoiser, DenoiserShape, NoiseLevels};
use quad_policy::{ActorCriticShape, SquashedActor};

pub(super) const DEFINITION: Definition = Definition {
    name: "dtql",
    presets: include_str!("../../presets/dtql.toml"),
    metrics: METRICS,
    chunks: true,
    read: |table| Ok(start(read(table)?, Dtql::new)),
    ..Definition::PLAIN
};

/// Divisor of the data's actions before atanh, which is infinite at ±1.
const ROOM: f64 = 1.001;

const METRICS: &[Metric] = &metrics! {
    target_q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·V(s').";
    v_mean ["V"] held_out: "Mean over the batch of the value V(s) before its step.";
    value_loss ["value loss"] held_out: "Expectile loss of V: mean over the batch of |expectile − 1(u < 0)|·u² with u = min_k Q_k(s, a) − V(s).";
    critic_loss ["critic loss"] held_out: "Sum over both critics of the mean over the batch of (Q_k(s, a) − y)².";
    bc_loss ["BC loss"] held_out: "Mean over batch and dimensions of the diffusion policy's squared error at the data's actions, ((D(a + σn; s, σ) − a)/c_out)². A network that always outputs 0 has loss 1 or so.";
    trust_loss ["trust loss"] held_out: "After pre-training: the same error at the one-step policy's actions.";
    q_loss ["Q loss"] held_out: "After pre-training: −mean over the batch of min_k Q_k(s, a) at the one-step policy's actions.";
    likelihood_loss held_out: "After pre-training, unless `likelihood` is 0: −mean over the batch of log π(a|s) at the data's actions, without the tanh's Jacobian.";
    actor_loss held_out: "After pre-training: α·(trust loss) + (Q loss) + `likelihood`·(likelihood loss).";
    learning_rate: "The learning rate of both policies.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The one-step policy π_θ.
    actor: MlpConfig,
    /// The diffusion policy μ_φ, behind a linear map as wide as its first layer.
    diffusion: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    gamma: UnitInterval,
    /// The expectile τ of the value function.
    expectile: OpenUnit,
    /// Strength α of the trust region beside Q.
    alpha: NotNegative,
    /// Strength of −log π_θ(a|s) at the data's actions.
    likelihood: NotNegative,
    /// Learning rate of both policies.
    learning_rate: Positive,
    /// Learning rate of critics and V.
    critic_learning_rate: Positive,
    /// Decay of all learning rates to 0 along a cosine, from the end of pre-training on.
    cosine: bool,
    ema_rate: Rate,
    candidates: Candidates,
    /// Temperature, in units of Q, of the softmax by which the policy draws one of its candidates.
    temperature: Positive,
    phases: Phases,
}

/// The phases' lengths in proportion.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Phases {
    pretraining: Steps,
    policy: Steps,
}

networks! {
    struct Dtql(config: Config, init) {
        /// π_θ.
        actor: Squashed = Squashed::new(&config.actor, SquashedActor::LOG_STD, init),
        /// The policy chooses by the target critics when it acts.
        critic: WithTarget<Ensemble> = init.critics(TWIN, &config.critic),
        value: TrainState<Ensemble> = init.value(&config.value),
        /// μ_φ.
        diffusion: TrainState<Denoiser> = {
            let shape = DenoiserShape {
                observation_dim: init.context.observation_dim(),
                action_dim: init.context.action_dim(),
                layers: config.diffusion.clone(),
            };
            let precision = init.context.precision;
            init.network(&shape.layout(), |weights| Denoiser::new(&shape, weights, precision))
        },
    }
}

/// Noise σ·n on the actions of a batch.
struct Noising {
    levels: NoiseLevels,
    /// n, `[B, a]`.
    noise: Tensor,
}

impl Noising {
    fn draw(random: &mut Random, loss: &str, (rows, action_dim): (usize, usize)) -> Result<Self> {
        let levels = random.vector(&format!("{loss}_sigma"), |generator| {
            NoiseLevels::draw(rows, generator).sigma(&Device::Cpu)?.flatten_all()?.to_vec1()
        })?;
        let noise = random.normal(&format!("{loss}_noise"), (rows, action_dim))?;
        Ok(Self { levels: NoiseLevels::new(levels), noise })
    }
}

struct Noise {
    /// Noise on the data's actions.
    cloning: Noising,
    /// Noise of π_θ's actions, `[B, 1, a]`.
    policy: Tensor,
    /// Noise on π_θ's actions in the trust loss.
    trust: Noising,
}

impl Dtql {
    /// The step at which π_θ begins to learn.
    fn pretraining(&self) -> u64 {
        let phases = self.config.phases;
        first_steps(self.context.total_steps, [phases.pretraining, phases.policy])[1]
    }

    fn noise(&self, step: u64, b: usize) -> Result<Noise> {
        let shape = (b, self.context.action_dim());
        let random = &mut self.context.random(step);
        Ok(Noise {
            cloning: Noising::draw(random, "bc", shape)?,
            policy: random.normal("policy_noise", (shape.0, 1, shape.1))?,
            trust: Noising::draw(random, "trust", shape)?,
        })
    }

    /// V(s) toward an expectile of the smaller Q(s, a), and Q(s, a) toward r + γ·V(s'), both as
    /// they are before this step.
    fn value_losses(&self, batch: &Batch) -> Result<[Loss; 2]> {
        let next = state_value(&self.value.detach(), &batch.next_observations)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        let q = batch.values(&self.critic)?;
        let v = state_value(&self.value, &batch.observations)?;
        let value_loss = expectile_loss(&(smallest(&q.detach())? - &v)?, *self.config.expectile)?;
        let critic_loss = (q.broadcast_sub(&targets)?.sqr()?.mean_all()? * TWIN as f64)?;
        Ok([
            Loss::new("value_loss", value_loss).with("v_mean", v.mean_all()?),
            Loss::critics(critic_loss, &targets)?,
        ])
    }

    /// μ_φ toward the data's actions.
    fn bc_loss(&self, batch: &Batch, noising: &Noising) -> Result<Loss> {
        let actions = &batch.actions;
        let learned = |clean| batch.within_episodes(clean, actions);
        let loss = denoising_loss(&self.diffusion, &batch.observations, actions, noising, learned)?;
        Ok(Loss::new("bc_loss", loss))
    }

    /// π_θ toward actions that the critics value and that μ_φ, which is fixed, denoises well.
    fn actor_loss(&self, batch: &Batch, noise: &Noise) -> Result<Loss> {
        let distribution = self.actor.distribution(&batch.observations)?;
        let drawn = distribution.draw(&noise.policy)?;
        let (actions, diffusion) = (drawn.actions.squeeze(1)?, self.diffusion.detach());
        let trust_loss =
            denoising_loss(&diffusion, &batch.observations, &actions, &noise.trust, Ok)?;
        let q = batch.values_at(&self.critic.detach(), &actions)?;
        let q_loss = smallest(&q)?.mean_all()?.neg()?;
        let mut loss = ((&trust_loss * f64::from(*self.config.alpha))? + &q_loss)?;
        let (weight, mut likelihood) = (*self.config.likelihood, None);
        if weight > 0.0 {
            let likelihood_loss = likelihood_loss(&distribution, batch)?;
            loss = (loss + (&likelihood_loss * f64::from(weight))?)?;
            likelihood = Some(likelihood_loss);
        }
        let loss = Loss::new("actor_loss", loss).with("trust_loss", trust_loss);
        Ok(loss.with("q_loss", q_loss).with("likelihood_loss", likelihood))
    }
}

/// Mean of ((D_φ(a + σn; s, σ) − a)/c_out)², `[]`, of actions `[B, a]`, through which the gradient
/// flows twice: the noisy ones and the clean ones. `learned` is what counts of the denoised ones.
fn denoising_loss(
    diffusion: &Denoiser,
    observations: &Tensor,
    actions: &Tensor,
    noising: &Noising,
    learned: impl FnOnce(Tensor) -> Result<Tensor>,
) -> Result<Tensor> {
    let device = actions.device();
    let Noising { levels, noise } = noising;
    let noisy = (actions + noise.broadcast_mul(&levels.sigma(device)?)?)?;
    let error = (learned(diffusion.denoise(observations, &noisy, levels)?)? - actions)?;
    error.broadcast_div(&levels.output_scale(device)?)?.sqr()?.mean_all()
}

/// −E[log N(atanh(a/1.001))] of the data's actions, `[]`: not of a, whose density would also have
/// the tanh's Jacobian, which does not depend on θ.
fn likelihood_loss(distribution: &Normal, batch: &Batch) -> Result<Tensor> {
    let scaled = (&batch.actions / ROOM)?;
    let u = (((1.0 + &scaled)?.log()? - (1.0 - &scaled)?.log()?)? * 0.5)?;
    let Normal { mean, log_std } = distribution;
    let mean = batch.within_episodes(mean.clone(), &u)?;
    let log_std = batch.within_episodes(log_std.clone(), &log_std.zeros_like()?)?;
    log_density(&u, &mean, &log_std)?.mean_all()?.neg()
}

impl Algorithm for Dtql {
    fn phases(&self) -> Vec<u64> {
        vec![0, self.pretraining()]
    }

    /// Critics and diffusion policy learn in both phases, the one-step policy in the second.
    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        let pretraining = self.pretraining();
        let steps = step.saturating_sub(pretraining);
        let decay = match self.config.cosine {
            true => cosine_decay(steps, self.context.total_steps - pretraining),
            false => 1.0,
        };
        let adam = AdamStep::after(step, *self.config.learning_rate * decay);
        let critic_adam = AdamStep::after(step, *self.config.critic_learning_rate * decay);
        let [value_loss, critic_loss] = self.value_losses(batch)?;
        let bc_loss = self.bc_loss(batch, &noise.cloning)?;
        self.value.minimize(&value_loss.value, critic_adam)?;
        self.critic.minimize(&critic_loss.value, critic_adam)?;
        self.diffusion.minimize(&bc_loss.value, adam)?;
        let mut losses = vec![value_loss, critic_loss, bc_loss];
        if step >= pretraining {
            let actor_loss = self.actor_loss(batch, &noise)?;
            let adam = AdamStep::after(step - pretraining, adam.rate);
            self.actor.minimize(&actor_loss.value, adam)?;
            self.critic.soft_update(*self.config.ema_rate)?;
            losses.push(actor_loss);
        }
        let mut measured = measured(&losses)?;
        measured.push(("learning_rate", adam.rate));
        Ok(measured)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        let noise = self.noise(step, batch.size())?;
        let mut losses = Vec::from(self.value_losses(batch)?);
        losses.push(self.bc_loss(batch, &noise.cloning)?);
        if step >= self.pretraining() {
            losses.push(self.actor_loss(batch, &noise)?);
        }
        measured(&losses)
    }

    /// The one-step policy, which draws one of its candidates by the target critics' values.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let rule = Rule::softmax(*self.config.temperature);
        let choice = Choice::new(*self.config.candidates, Aggregate::Min, rule);
        let (actor, critics) = (&self.actor.network, &self.critic.target);
        let (shape, tensors) = ActorCriticShape::from_networks(actor, critics)?;
        Ok((PolicyConfig::Squashed { shape, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks()
    }
}
