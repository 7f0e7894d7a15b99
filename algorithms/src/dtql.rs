//! Diffusion Trusted Q-Learning (Chen, Wang and Zhou 2024, "Diffusion Policies creating a Trust
//! Region for Offline Reinforcement Learning"): a diffusion policy μ_φ only clones the data. How
//! badly it denoises the actions of a second policy π_θ, of one step, says how far these are from
//! the data's: inside that trust region π_θ moves toward large Q, and no chain of denoising steps
//! is ever sampled. Where the authors' code says more than their paper, docs/deviations.md has it.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/dtql.rs"]
mod golden;

use super::algorithm::{Algorithm, Loss, Measured, measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::denoising::normal;
use super::gaussian::log_density;
use super::hyperparameters::{
    Candidates, NotNegative, OpenUnit, Positive, Rate, Steps, UnitInterval,
};
use super::iql::expectile_loss;
use super::parts::Parts;
use super::phases;
use super::random::{Purpose, stream};
use super::squashed::{Normal, Squashed};
use super::train_state::{TrainState, ensemble, initial};
use candle_core::{Result, Tensor};
use quad_nn::{
    AdamStep, Denoiser, DenoiserShape, Ensemble, EnsembleShape, MlpConfig, NoiseLevels, Tensors,
    Weighted, cosine_decay,
};
use quad_policy::{ActorCriticShape, Aggregate, Choice, PolicyConfig, Rule, SquashedActor};
use rand_chacha::ChaCha8Rng;
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "dtql",
    settings: include_str!("../../presets/dtql.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(Dtql::new(read(table)?, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;
/// What the data's actions are divided by before atanh, which is infinite at ±1.
const ROOM: f64 = 1.001;

const METRICS: &[Metric] = &metrics! {
    q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·V(s').";
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

/// DTQL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// The one-step policy π_θ.
    actor: MlpConfig,
    /// The diffusion policy μ_φ, behind a linear map as wide as its first layer.
    diffusion: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    /// Discount γ.
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
    /// Whether all learning rates fall to 0 along a cosine, from the end of pre-training on.
    cosine: bool,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    /// Actions that an evaluated policy draws in each state.
    candidates: Candidates,
    /// Temperature of the softmax by which one of them is drawn, in units of Q.
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

/// Noise for the actions of a batch.
struct Noising {
    levels: NoiseLevels,
    /// n, `[B, a]`.
    noise: Tensor,
}

/// The random numbers of one update.
struct Noise {
    /// For the data's actions.
    cloning: Noising,
    /// By which π_θ draws its actions, `[B, a]`.
    policy: Tensor,
    /// For these.
    trust: Noising,
}

/// DTQL in the middle of a run.
struct Dtql {
    config: Config,
    context: Context,
    /// μ_φ.
    diffusion: TrainState<Denoiser>,
    /// π_θ.
    actor: Squashed,
    /// V.
    value: TrainState<Ensemble>,
    /// Q_1 and Q_2, and their EMA, by which the policy chooses when it acts.
    critics: TrainState<Ensemble>,
    target_critics: Ensemble,
}

impl Dtql {
    fn new(config: Config, context: Context) -> Result<Self> {
        let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
        let shape = DenoiserShape { observation_dim, action_dim, layers: config.diffusion.clone() };
        let diffusion = Denoiser::new(&shape, initial(&shape.layout(), &context, 3)?);
        let shape = |members, action_dim, layers: &MlpConfig| EnsembleShape {
            members,
            observation_dim,
            action_dim,
            layers: layers.clone(),
            outputs: 1,
        };
        let critics = ensemble(shape(CRITICS, action_dim, &config.critic), &context, 1)?;
        Ok(Self {
            diffusion: TrainState::new(diffusion, 0.0)?,
            actor: Squashed::new(&config.actor, SquashedActor::LOG_STD, None, &context, 0)?,
            value: ensemble(shape(1, 0, &config.value), &context, 2)?,
            target_critics: critics.network.copy()?,
            critics,
            config,
            context,
        })
    }

    /// The step at which π_θ begins to learn.
    fn pretraining(&self) -> u64 {
        let Phases { pretraining, policy } = self.config.phases;
        phases::begin(self.context.total_steps, [pretraining, policy])[1]
    }

    /// Update number `step`: critics and diffusion policy in both phases, then the one-step policy
    /// in the second.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Noise) -> Result<Measured> {
        let pretraining = self.pretraining();
        let decay = match self.config.cosine {
            true => cosine_decay(
                step.saturating_sub(pretraining),
                self.context.total_steps - pretraining,
            ),
            false => 1.0,
        };
        let rate = *self.config.learning_rate * decay;
        let adam = AdamStep::after(step, rate);
        let of_values = AdamStep { rate: *self.config.critic_learning_rate * decay, ..adam };
        let [value_loss, critic_loss] = self.value_losses(batch)?;
        self.value.minimize(&value_loss.value, of_values)?;
        self.critics.minimize(&critic_loss.value, of_values)?;
        let bc_loss = self.bc_loss(batch, &noise.cloning)?;
        self.diffusion.minimize(&bc_loss.value, adam)?;
        let mut losses = vec![value_loss, critic_loss, bc_loss];
        if step >= pretraining {
            let actor_loss = self.actor_loss(batch, noise)?;
            self.actor
                .minimize(&actor_loss.value, AdamStep { count: step - pretraining + 1, ..adam })?;
            self.target_critics.soft_update(&self.critics.network, *self.config.ema_rate)?;
            losses.push(actor_loss);
        }
        let mut measured = measured(&losses)?;
        measured.push(("learning_rate", rate));
        Ok(measured)
    }

    /// V(s) toward an expectile of the smaller Q(s, a), and Q(s, a) toward r + γ·V(s'), both as
    /// they are before this step.
    fn value_losses(&self, batch: &Minibatch) -> Result<[Loss; 2]> {
        let next =
            self.value.network.detach().state_values(&batch.next_observations)?.squeeze(0)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        let q = self.critics.network.values(&batch.observations, &batch.actions)?;
        let v = self.value.network.state_values(&batch.observations)?.squeeze(0)?;
        let value_loss = expectile_loss(&(smaller(&q.detach())? - &v)?, *self.config.expectile)?;
        let critic_loss = (q.broadcast_sub(&targets)?.sqr()?.mean_all()? * CRITICS as f64)?;
        let critic_loss = Loss::new("critic_loss", critic_loss).with("q_mean", targets.mean_all()?);
        Ok([Loss::new("value_loss", value_loss).with("v_mean", v.mean_all()?), critic_loss])
    }

    /// μ_φ toward the data's actions.
    fn bc_loss(&self, batch: &Minibatch, noising: &Noising) -> Result<Loss> {
        let loss =
            denoising_loss(&self.diffusion.network, &batch.observations, &batch.actions, noising)?;
        Ok(Loss::new("bc_loss", loss))
    }

    /// π_θ toward actions that the critics value and that μ_φ, which is fixed, denoises well.
    fn actor_loss(&self, batch: &Minibatch, noise: &Noise) -> Result<Loss> {
        let distribution = self.actor.distribution(&batch.observations)?;
        let actions = distribution.draw(&noise.policy.unsqueeze(1)?)?.actions.squeeze(1)?;
        let diffusion = self.diffusion.network.detach();
        let trust_loss = denoising_loss(&diffusion, &batch.observations, &actions, &noise.trust)?;
        let q = smaller(&self.critics.network.detach().values(&batch.observations, &actions)?)?;
        let q_loss = q.mean_all()?.neg()?;
        let mut loss = ((&trust_loss * f64::from(*self.config.alpha))? + &q_loss)?;
        let likelihood =
            (*self.config.likelihood > 0.0).then(|| likelihood_loss(&distribution, &batch.actions));
        let likelihood = likelihood.transpose()?;
        if let Some(likelihood) = &likelihood {
            loss = (loss + (likelihood * f64::from(*self.config.likelihood))?)?;
        }
        let loss =
            Loss::new("actor_loss", loss).with("trust_loss", trust_loss).with("q_loss", q_loss);
        Ok(loss.with("likelihood_loss", likelihood))
    }

    /// The random numbers of update number `step`.
    fn noise(&self, step: u64) -> Result<Noise> {
        let mut generator = stream(self.context.seed, Purpose::Noise, step);
        let (batch, action_dim) = (self.context.batch_size, self.context.action_dim());
        let rows = |generator: &mut ChaCha8Rng| {
            normal((batch, action_dim), generator, &self.context.device)
        };
        let levels = NoiseLevels::draw(batch, &mut generator);
        let cloning = Noising { levels, noise: rows(&mut generator)? };
        let policy = rows(&mut generator)?;
        let levels = NoiseLevels::draw(batch, &mut generator);
        Ok(Noise { cloning, policy, trust: Noising { levels, noise: rows(&mut generator)? } })
    }
}

/// Mean of ((D_φ(a + σn; s, σ) − a)/c_out)², `[]`, of actions `[B, a]`, through which the gradient
/// flows twice: the noisy ones and the clean ones.
fn denoising_loss(
    diffusion: &Denoiser,
    observations: &Tensor,
    actions: &Tensor,
    noising: &Noising,
) -> Result<Tensor> {
    let device = actions.device();
    let noisy = (actions + noising.noise.broadcast_mul(&noising.levels.sigma(device)?)?)?;
    let error = (diffusion.denoise(observations, &noisy, &noising.levels)? - actions)?;
    error.broadcast_div(&noising.levels.output_scale(device)?)?.sqr()?.mean_all()
}

/// −E[log N(atanh(a/1.001))] of the data's actions, `[]`: not of a, whose density would also have
/// the tanh's Jacobian, which does not depend on θ.
fn likelihood_loss(distribution: &Normal, actions: &Tensor) -> Result<Tensor> {
    let scaled = (actions / ROOM)?;
    let u = (((1.0 + &scaled)?.log()? - (1.0 - &scaled)?.log()?)? * 0.5)?;
    log_density(&u, &distribution.mean, &distribution.log_std)?.mean_all()?.neg()
}

impl Algorithm for Dtql {
    fn phases(&self) -> Vec<u64> {
        vec![0, self.pretraining()]
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        self.step(step, &batch, &noise)
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        let mut losses = Vec::from(self.value_losses(&batch)?);
        losses.push(self.bc_loss(&batch, &noise.cloning)?);
        if step >= self.pretraining() {
            losses.push(self.actor_loss(&batch, &noise)?);
        }
        measured(&losses)
    }

    /// The one-step policy as it is; one of its candidates is drawn by what the target critics say
    /// of them.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let Config { actor, critic, candidates, temperature, .. } = &self.config;
        let shape = ActorCriticShape {
            observation_dim: self.context.observation_dim(),
            action_dim: self.context.action_dim(),
            actor: actor.clone(),
            critic: critic.clone(),
            critics: CRITICS,
        };
        let rule = Rule::Softmax { temperature: **temperature };
        let choice = Choice { candidates: **candidates, value: Aggregate::Min, rule };
        let tensors = ActorCriticShape::tensors(&self.actor.network.network, &self.target_critics)?;
        Ok((PolicyConfig::Squashed { shape, choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        let parts = Parts::default()
            .trained("diffusion", &mut self.diffusion)
            .trained("value", &mut self.value)
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut());
        self.actor.parts(parts)
    }
}
