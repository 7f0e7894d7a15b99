//! TD3+BC (Fujimoto and Gu 2021, "A Minimalist Approach to Offline Reinforcement Learning"): TD3 whose policy also stays near the
//! data's actions. Its update is its authors' code's; equations are that paper's.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/td3bc.rs"]
mod golden;

use super::algorithm::{Algorithm, Measured, joined, measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::denoising::normal;
use super::hyperparameters::{NotNegative, Positive, Rate, Share, Steps};
use super::parts::{Parts, write};
use super::random::{Purpose, stream};
use super::trained::{Trained, ensemble};
use candle_core::{DType, Result, Tensor};
use quad_policy::{
    AdamStep, Ensemble, EnsembleShape, GaussianPolicy, GaussianShape, MlpConfig, PolicyConfig, Tensors, Weighted,
    gaussian_mean,
};
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "td3-bc",
    settings: include_str!("../../presets/td3-bc.toml"),
    metrics: METRICS,
    report: Reporting::PLAIN,
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(Td3Bc::new(read(table)?, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;

const METRICS: &[Metric] = &metrics! {
    q_mean ["Q"]: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', ã'), where ã' is the target policy's action with noise.";
    critic_loss ["critic loss"]: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)².";
    actor_loss ["actor loss"]: "−λ·mean Q_1(s, π(s)) + mean (π(s) − a)² with λ = weight/mean |Q_1(s, π(s))| (TD3+BC's Eq. 3 to 5), in the policy's last step.";
    bc_loss: "Mean over batch and dimensions of (π(s) − a)², in the policy's last step.";
};

/// TD3+BC's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    /// Discount γ.
    gamma: Share,
    /// Weight of Q against the distance to the data, the paper's α.
    weight: Positive,
    /// Standard deviation of the noise in the targets' actions, and its largest size.
    target_noise: NotNegative,
    target_noise_limit: NotNegative,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    /// EMA rate of the target networks.
    ema_rate: Rate,
    /// Policy and targets move in every so many steps.
    actor_every: Steps,
}

/// TD3+BC in the middle of a run.
struct Td3Bc {
    config: Config,
    context: Context,
    /// π is the tanh of this.
    actor: Trained<Ensemble>,
    target_actor: Ensemble,
    critics: Trained<Ensemble>,
    target_critics: Ensemble,
    /// What the policy's last step measured: `actor_loss` and `bc_loss`.
    of_actor: Tensor,
}

impl Td3Bc {
    fn new(config: Config, context: Context) -> Result<Self> {
        let shape = EnsembleShape {
            members: CRITICS,
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            layers: config.critic.clone(),
            outputs: 1,
        };
        let actor = ensemble(actor_shape(&config, &context).actor(), &context, 0)?;
        let critics = ensemble(shape, &context, 1)?;
        Ok(Self {
            target_actor: actor.network.copy()?,
            target_critics: critics.network.copy()?,
            of_actor: Tensor::zeros(2, DType::F32, &context.device)?,
            actor,
            critics,
            config,
            context,
        })
    }

    /// Update number `step`, with standard normal noise of the targets' actions, `[B, a]`.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Tensor) -> Result<Measured> {
        let Config { actor_every, ema_rate, .. } = self.config;
        let targets = self.targets(batch, noise)?;
        let q = self.critics.network.values(&batch.observations, &batch.actions)?;
        let critic_loss = (q.broadcast_sub(&targets)?.sqr()?.mean_all()? * CRITICS as f64)?;
        self.critics.descend(&critic_loss, adam(*self.config.critic_learning_rate, step))?;
        if (step + 1).is_multiple_of(*actor_every) {
            let [actor_loss, bc_loss] = self.actor_losses(batch)?;
            self.actor.descend(&actor_loss, adam(*self.config.actor_learning_rate, step / *actor_every))?;
            self.target_critics.follow(&self.critics.network, *ema_rate)?;
            self.target_actor.follow(&self.actor.network, *ema_rate)?;
            write(&self.of_actor, &joined(&[&actor_loss, &bc_loss])?.detach())?;
        }
        measured([
            ("q_mean", &targets.mean_all()?),
            ("critic_loss", &critic_loss),
            ("actor_loss", &self.of_actor.get(0)?),
            ("bc_loss", &self.of_actor.get(1)?),
        ])
    }

    /// y = r + γ·mask·min_k Q̂_k(s', ã'), `[B]`.
    fn targets(&self, batch: &Minibatch, noise: &Tensor) -> Result<Tensor> {
        let limit = f64::from(*self.config.target_noise_limit);
        let noise = (noise * f64::from(*self.config.target_noise))?.clamp(-limit, limit)?;
        let actions = (gaussian_mean(&self.target_actor, &batch.next_observations)? + noise)?.clamp(-1.0, 1.0)?;
        batch.target(*self.config.gamma, &smaller(&self.target_critics.values(&batch.next_observations, &actions)?)?)
    }

    /// −λ·mean Q_1(s, π(s)) + mean (π(s) − a)², and the latter.
    fn actor_losses(&self, batch: &Minibatch) -> Result<[Tensor; 2]> {
        let actions = gaussian_mean(&self.actor.network, &batch.observations)?;
        let q = self.critics.network.detach().values(&batch.observations, &actions)?.get(0)?;
        let weight = (q.detach().abs()?.mean_all()?.recip()? * f64::from(*self.config.weight))?;
        let bc_loss = (&actions - &batch.actions)?.sqr()?.mean_all()?;
        Ok([(&bc_loss - (q.mean_all()? * weight)?)?, bc_loss])
    }
}

/// Adam's step after so many others.
fn adam(rate: f32, steps: u64) -> AdamStep {
    AdamStep { rate, clip: None, count: steps + 1 }
}

fn actor_shape(config: &Config, context: &Context) -> GaussianShape {
    let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
    GaussianShape { observation_dim, action_dim, actor: config.actor.clone() }
}

impl Algorithm for Td3Bc {
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let generator = &mut stream(self.context.seed, Purpose::Noise, step);
        let noise = normal((self.context.batch_size, self.context.action_dim()), generator, &self.context.device)?;
        self.step(step, &self.context.batch(items)?, &noise)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let shape = actor_shape(&self.config, &self.context);
        Ok((PolicyConfig::Gaussian { shape }, GaussianPolicy::tensors(&self.actor.network)?))
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("actor", &mut self.actor)
            .weights("target_actor", self.target_actor.weights_mut())
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut())
            .number("of_actor", &mut self.of_actor)
    }
}
