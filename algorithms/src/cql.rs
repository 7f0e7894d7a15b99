//! CQL (Kumar, Zhou, Tucker and Levine 2020, "Conservative Q-Learning for Offline Reinforcement
//! Learning"): soft actor-critic whose critics are also pushed down at actions that the policy
//! takes and up at those of the data, so that they do not promise more than the policy is worth.
//! Equations are that paper's; docs/deviations.md says which of several codes is followed.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/cql.rs"]
mod golden;

use super::algorithm::{Algorithm, AlgorithmError, Loss, Measured, largest, measured, smaller};
use super::context::{Context, Minibatch};
use super::definition::{Definition, Metric, Reporting, metrics, read, readable};
use super::denoising::normal;
use super::hyperparameters::{Count, Finite, Positive, Rate, Steps, UnitInterval};
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::squashed::{Normal, Squashed};
use super::train_state::{TrainState, ensemble, learned, scale_last_layer};
use candle_core::{Result, Tensor};
use quad_nn::{AdamStep, Ensemble, EnsembleShape, MlpConfig, Tensors, Weighted, Weights};
use quad_policy::PolicyConfig;
use rand::Rng;
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "cql",
    settings: include_str!("../../presets/cql.toml"),
    metrics: METRICS,
    report: Reporting::PLAIN,
    check: readable::<Config>,
    start: |table, context| Ok(Box::new(Cql::new(read(table)?, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;
/// Bounds of log σ.
const LOG_STD: (f32, f32) = (-20.0, 2.0);
/// How much smaller than the others the last layers begin.
const LAST_LAYER: f64 = 0.01;
/// log α' at the beginning, and the largest α'.
const LOG_ALPHA_PRIME: f32 = 1.0;
const MOST_ALPHA_PRIME: f64 = 1e6;

const METRICS: &[Metric] = &metrics! {
    q_mean held_out: "Mean over the batch of the critics' target y = r + γ·mask·min_k Q̂_k(s', a') with a' from the policy; of several a' the best.";
    critic_loss ["critic loss"] held_out: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)² (the last term of CQL's Eq. 3).";
    gap ["gap"] held_out: "Mean over batch and critics of log Σ exp Q_k(s, ·) − Q_k(s, a), which the critics also descend (CQL's Eq. 4); below 0 where the data's action is worth more than all others together.";
    actor_loss ["actor loss"] held_out: "Mean over the batch of α·log π(a|s) − min_k Q_k(s, a) with a from the policy; while the policy is cloned, −log π of the data's action is in the place of −min_k Q_k.";
    entropy ["entropy"] held_out: "−mean over the batch of log π(a|s) with a from the policy; α holds it at −(dimensions of an action).";
    alpha: "α, the weight of the entropy in the actor's loss, before its step.";
    alpha_prime: "α', which the weight of the gap is multiplied by, before its step; rises while the gap is above the threshold. Measured with a threshold only.";
};

/// CQL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    /// Discount γ.
    gamma: UnitInterval,
    /// Weight w of the gap in the critics' loss, the paper's α.
    weight: Positive,
    /// Gap to which α' drives the critics; without it there is no α'.
    threshold: Option<Finite>,
    /// Each state's gap counts as at least this.
    least_gap: Option<Finite>,
    /// Uniform actions, actions of the policy at s and at s' over which the gap of a state is
    /// taken: so many of each.
    actions: Count,
    /// Next actions drawn per next state for the target; of several, the best counts.
    samples: Count,
    log_std: LogStd,
    /// Also α's.
    actor_learning_rate: Positive,
    /// Also that of α'.
    critic_learning_rate: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
    phases: Phases,
}

/// What c₁ and c₂ begin with in log σ = c₁·x + c₂, where x comes from the policy's network.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LogStd {
    multiplier: Finite,
    offset: Finite,
}

/// The phases' lengths in proportion: the policy clones the data, then it follows the critics.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Phases {
    cloning: u64,
    learning: Steps,
}

impl Phases {
    /// Whether the policy is cloned in this step of a run of so many.
    fn is_cloning(&self, step: u64, total_steps: u64) -> bool {
        let [step, total, cloning, learning] =
            [step, total_steps, self.cloning, *self.learning].map(u128::from);
        step * (cloning + learning) < total * cloning
    }
}

/// The random numbers of one update.
struct Noise {
    /// For the action of the actor's loss, `[B, 1, a]`.
    policy: Tensor,
    /// For the target's next actions, `[B, S, a]`.
    target: Tensor,
    /// Actions from all over the range, `[B, N, a]`.
    uniform: Tensor,
    /// For the gap's actions of the policy at s' and at s, `[B, N, a]` each.
    next: Tensor,
    current: Tensor,
}

/// CQL in the middle of a run.
struct Cql {
    config: Config,
    context: Context,
    actor: Squashed,
    /// Q_1 and Q_2, and their EMA Q̂.
    critics: TrainState<Ensemble>,
    target_critics: Ensemble,
    /// log α, `[1]`.
    log_alpha: TrainState<Weights>,
    /// log α', `[1]`.
    log_alpha_prime: Option<TrainState<Weights>>,
}

impl Cql {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let shape = EnsembleShape {
            members: CRITICS,
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            layers: config.critic.clone(),
            outputs: 1,
        };
        let LogStd { multiplier, offset } = config.log_std;
        let mut actor =
            Squashed::new(&config.actor, LOG_STD, Some([*multiplier, *offset]), &context, 0)?;
        let mut critics = ensemble(shape, &context, 1)?;
        scale_last_layer(actor.network.network.weights_mut(), &config.actor, LAST_LAYER)?;
        scale_last_layer(critics.network.weights_mut(), &config.critic, LAST_LAYER)?;
        let number = |begin| learned("value", &[begin], &context);
        Ok(Self {
            target_critics: critics.network.copy()?,
            log_alpha: number(0.0)?,
            log_alpha_prime: config.threshold.map(|_| number(LOG_ALPHA_PRIME)).transpose()?,
            actor,
            critics,
            config,
            context,
        })
    }

    /// The random numbers of update number `step`.
    fn noise(&self, step: u64) -> Result<Noise> {
        let Context { seed, batch_size, ref device, .. } = self.context;
        let (generator, a) = (&mut stream(seed, Purpose::Noise, step), self.context.action_dim());
        let each = (batch_size, *self.config.actions, a);
        let uniform: Vec<f32> =
            (0..each.0 * each.1 * a).map(|_| generator.random_range(-1.0..1.0)).collect();
        Ok(Noise {
            policy: normal((batch_size, 1, a), generator, device)?,
            target: normal((batch_size, *self.config.samples, a), generator, device)?,
            uniform: Tensor::from_vec(uniform, each, device)?,
            next: normal(each, generator, device)?,
            current: normal(each, generator, device)?,
        })
    }

    /// Update number `step`, from 0. All losses are of the networks as they are before it.
    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Noise) -> Result<Measured> {
        let adam = |rate: f32| AdamStep::after(step, rate);
        let (slow, fast) =
            (adam(*self.config.actor_learning_rate), adam(*self.config.critic_learning_rate));
        let current = self.actor.distribution(&batch.observations)?;
        let next = self.actor.constant_distribution(&batch.next_observations)?;
        // The policy, and α so that the entropy is −(dimensions of an action).
        let (actor_loss, log_density) = self.actor_loss(step, batch, &current, noise)?;
        self.actor.minimize(&actor_loss.value, slow)?;
        let excess = (log_density - self.context.action_dim() as f64)?;
        self.log_alpha
            .minimize(&(self.log_alpha.network.values().sum_all()? * excess)?.neg()?, slow)?;

        let (critic_loss, gap) = self.critic_loss(batch, &current.detach(), &next, noise)?;
        let (weight, alpha_prime) = self.weight(&gap.detach(), fast)?;
        let conservative = (gap * weight)?;
        self.critics.minimize(&(&critic_loss.value + (conservative * CRITICS as f64)?)?, fast)?;
        self.target_critics.soft_update(&self.critics.network, *self.config.ema_rate)?;
        measured(&[actor_loss, critic_loss.with("alpha_prime", alpha_prime)])
    }

    /// The policy toward large Q and entropy; and the mean of its log density, `[]`, a constant.
    fn actor_loss(
        &self,
        step: u64,
        batch: &Minibatch,
        current: &Normal,
        noise: &Noise,
    ) -> Result<(Loss, Tensor)> {
        let drawn = current.draw(&noise.policy)?;
        let log_density = drawn.log_density.squeeze(1)?;
        let worth = match self.config.phases.is_cloning(step, self.context.total_steps) {
            true => current.log_density(&self.actions(batch)?)?,
            false => smaller(
                &self
                    .critics
                    .network
                    .detach()
                    .values(&batch.observations, &drawn.actions.squeeze(1)?)?,
            )?,
        };
        let alpha = self.log_alpha.network.values().detach().exp()?;
        let loss =
            Loss::new("actor_loss", (log_density.broadcast_mul(&alpha)? - worth)?.mean_all()?);
        let log_density = log_density.detach().mean_all()?;
        Ok((loss.with("entropy", log_density.neg()?).with("alpha", alpha), log_density))
    }

    /// The critics toward r + γ·Q̂(s', a'); and how far they also go down, the gap between all
    /// actions at s and the data's, `[]`.
    fn critic_loss(
        &self,
        batch: &Minibatch,
        current: &Normal,
        next: &Normal,
        noise: &Noise,
    ) -> Result<(Loss, Tensor)> {
        let targets = self.targets(batch, next, &noise.target)?;
        let (q, gaps) = self.gaps(batch, current, next, noise)?;
        let loss = (q.broadcast_sub(&targets)?.sqr()?.mean_all()? * CRITICS as f64)?;
        let gap = gaps.mean_all()?;
        Ok((
            Loss::new("critic_loss", loss)
                .with("q_mean", targets.mean_all()?)
                .with("gap", gap.clone()),
            gap,
        ))
    }

    /// The data's actions, clipped in all steps of a run that clones: at ±1 the density of a
    /// squashed Gaussian has no limit.
    fn actions(&self, batch: &Minibatch) -> Result<Tensor> {
        let bound = if self.config.phases.cloning > 0 { 0.999 } else { 1.0 };
        batch.actions.clamp(-bound, bound)
    }

    /// y = r + γ·mask·max_a' min_k Q̂_k(s', a') over the actions drawn with this noise, `[B, S,
    /// a]`; `[B]`.
    fn targets(&self, batch: &Minibatch, next: &Normal, noise: &Tensor) -> Result<Tensor> {
        let actions = next.draw(noise)?.actions;
        let q = self.target_critics.values(&batch.next_observations, &actions.flatten(0, 1)?)?;
        batch.target(
            *self.config.gamma,
            &largest(&smaller(&q)?.reshape(((), *self.config.samples))?, 1)?,
        )
    }

    /// Q_k(s, a) of the data's actions, and log Σ exp Q_k(s, ·) − Q_k(s, a): Eq. 4 with the sum
    /// over uniform actions and those of the policy at s and s', all at s, each divided by its
    /// density (appendix F); `[K, B]` each.
    fn gaps(
        &self,
        batch: &Minibatch,
        current: &Normal,
        next: &Normal,
        noise: &Noise,
    ) -> Result<(Tensor, Tensor)> {
        let (b, n, a) = noise.uniform.dims3()?;
        let [next, current] = [next.draw(&noise.next)?, current.draw(&noise.current)?];
        // [B, 1 + 3N, a]: one pass through the critics for all.
        let actions =
            [&self.actions(batch)?.unsqueeze(1)?, &noise.uniform, &next.actions, &current.actions];
        let actions = Tensor::cat(&actions, 1)?.flatten(0, 1)?;
        let q = self.critics.network.values(&batch.observations, &actions)?.reshape((
            CRITICS,
            b,
            1 + 3 * n,
        ))?;
        let of_data = q.narrow(2, 0, 1)?.squeeze(2)?;
        let uniform = Tensor::full(-(a as f32) * 2f32.ln(), (b, n), q.device())?;
        let densities = Tensor::cat(&[&uniform, &next.log_density, &current.log_density], 1)?;
        let corrected = q.narrow(2, 1, 3 * n)?.broadcast_sub(&densities)?;
        let least = self.config.least_gap.map_or(f64::NEG_INFINITY, |least| f64::from(*least));
        let gaps = (log_sum_exp(&corrected)? - &of_data)?.maximum(least)?;
        Ok((of_data, gaps))
    }

    /// The weight of the gap in the critics' loss, with α' if there is one (appendix, dual gradient
    /// descent), and α'. Moves α' up a gap above the threshold.
    fn weight(&mut self, gap: &Tensor, adam: AdamStep) -> Result<(Tensor, Option<Tensor>)> {
        let weight = f64::from(*self.config.weight);
        let (Some(learned), Some(threshold)) = (&mut self.log_alpha_prime, self.config.threshold)
        else {
            return Ok(((gap.ones_like()? * weight)?, None));
        };
        let alpha_prime =
            learned.network.values().exp()?.clamp(0.0, MOST_ALPHA_PRIME)?.sum_all()?;
        let excess = ((gap - f64::from(*threshold))? * weight)?;
        learned.minimize(&(&alpha_prime * excess)?.neg()?, adam)?;
        let alpha_prime = alpha_prime.detach();
        Ok(((&alpha_prime * weight)?, Some(alpha_prime)))
    }
}

/// log Σ exp over the last of three dimensions, which it removes.
fn log_sum_exp(x: &Tensor) -> Result<Tensor> {
    let most = x.max_keepdim(2)?.detach();
    (x.broadcast_sub(&most)?.exp()?.sum_keepdim(2)?.log()? + most)?.squeeze(2)
}

impl Algorithm for Cql {
    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        self.step(step, &batch, &noise)
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        let current = self.actor.constant_distribution(&batch.observations)?;
        let next = self.actor.constant_distribution(&batch.next_observations)?;
        let (actor_loss, _) = self.actor_loss(step, &batch, &current, &noise)?;
        let (critic_loss, _) = self.critic_loss(&batch, &current, &next, &noise)?;
        measured(&[actor_loss, critic_loss])
    }

    /// Acts by the tanh of the mean.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        self.actor.policy(&self.context)
    }

    fn parts(&mut self) -> Parts<'_> {
        let parts = Parts::default()
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut())
            .trained("log_alpha", &mut self.log_alpha);
        let parts = match &mut self.log_alpha_prime {
            Some(log_alpha_prime) => parts.trained("log_alpha_prime", log_alpha_prime),
            None => parts,
        };
        self.actor.parts(parts)
    }
}
