//! AlignIQL (He, Shen and Wang 2024, "AlignIQL: Policy Alignment in Implicit Q-Learning through Constrained Optimization"):
//! IQL's critics and a diffusion policy that only clones the data, trained side by side. The policy is aligned with the
//! critics when it acts: of its samples it takes the one whose Q is closest to V. Equations of critics and V are IQL's; what
//! is left out, and what its authors' code does, is in docs/deviations.md.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/align_iql.rs"]
mod golden;

use super::algorithm::{Algorithm, AlgorithmError, Definition, Metric, numbers, read, smaller};
use super::context::{Context, Minibatch};
use super::diffusion::{Denoising, noise_predictor};
use super::hyperparameters::{Candidates, Count, NotNegative, Positive, Quantile, Rate, Share};
use super::iql::expectile_loss;
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::trained::{Trained, ensemble};
use candle_core::Result;
use quad_policy::{
    AdamStep, Choice, DiffusionPolicy, DiffusionShape, Ensemble, EnsembleShape, Gradients, MlpConfig, NoisePredictor,
    PolicyConfig, Reduce, Reverse, Rule, Tensors, cosine_decay,
};
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "align-iql",
    settings: include_str!("../../presets/align-iql.toml"),
    variant: None,
    metrics: METRICS,
    check: |table| read::<Config>(table).map(drop),
    start: |table, context| Ok(Box::new(AlignIql::new(read(table)?, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;

const METRICS: &[Metric] = &[
    Metric {
        name: "q_mean",
        label: "",
        help: "Mean over the batch of the critics' target y = r + γ·mask·V(s') (IQL's Eq. 6).",
    },
    Metric { name: "v_mean", label: "V", help: "Mean over the batch of the value V(s) after its step." },
    Metric {
        name: "value_loss",
        label: "value loss",
        help: "Expectile loss of V: mean over the batch of |expectile − 1(u < 0)|·u² with u = min_k Q̂_k(s, a) − V(s) (IQL's Eq. 5).",
    },
    Metric {
        name: "critic_loss",
        label: "critic loss",
        help: "Mean over critics and batch of (Q_k(s, a) − y)² (IQL's Eq. 6).",
    },
    Metric {
        name: "bc_loss",
        label: "BC loss",
        help: "Mean over the batch of the sum over dimensions of (ε − ε_θ(a^t, s, t))². The number of dimensions is a predictor that always says 0.",
    },
    Metric {
        name: "advantage_mean",
        label: "",
        help: "Mean over the batch of the advantage min_k Q̂_k(s, a) − V(s): the policy takes the sample for which it is closest to 0.",
    },
    Metric { name: "learning_rate", label: "", help: "The actor's learning rate; falls to 0 along a cosine." },
];

/// AlignIQL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    /// Denoising steps T.
    diffusion_steps: Count,
    /// Discount γ.
    gamma: Share,
    /// The expectile τ of the value function.
    expectile: Quantile,
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

/// AlignIQL in the middle of a run.
struct AlignIql {
    config: Config,
    context: Context,
    shape: DiffusionShape,
    /// ε_θ and its EMA.
    actor: Trained<NoisePredictor>,
    target_actor: NoisePredictor,
    /// Q_1 and Q_2, and their EMA Q̂.
    critics: Trained<Ensemble>,
    target_critics: Ensemble,
    /// V.
    value: Trained<Ensemble>,
}

impl AlignIql {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        let shape = DiffusionShape {
            observation_dim: context.observation_dim(),
            action_dim: context.action_dim(),
            actor: config.actor.clone(),
            critic: config.critic.clone(),
            value: Some(config.value.clone()),
            critics: CRITICS,
            diffusion_steps: *config.diffusion_steps,
            reverse: Reverse::ClipSample,
        };
        let (actor, target_actor) = noise_predictor(shape.actor(), *config.weight_decay, &context, 0)?;
        let critics = ensemble(shape.critics(), &context, 1)?;
        let value = EnsembleShape { members: 1, action_dim: 0, layers: config.value.clone(), ..shape.critics() };
        Ok(Self {
            actor,
            target_actor,
            target_critics: critics.network.copy()?,
            critics,
            value: ensemble(value, &context, 2)?,
            shape,
            config,
            context,
        })
    }

    fn noise(&self, step: u64) -> Result<Denoising> {
        let mut generator = stream(self.context.seed, Purpose::Noise, step);
        Denoising::draw(self.actor.network.shape(), self.context.batch_size, &mut generator, &self.context.device)
    }

    fn step(&mut self, step: u64, batch: &Minibatch, noise: &Denoising) -> Result<Vec<f32>> {
        let adam = |rate: f32| AdamStep { rate, clip: None, count: step + 1 };

        // The policy: cloning, whatever the actions are worth.
        let noisy = noise.noisy(self.actor.network.schedule(), &batch.actions)?;
        let predicted = self.actor.network.predict(&batch.observations, &noisy.actions, &noisy.t)?;
        let bc_loss = (predicted - &noise.epsilon)?.sqr()?.sum(1)?.mean_all()?;
        let rate = *self.config.actor_learning_rate * cosine_decay(step, self.context.total_steps);
        self.actor.descend(&Gradients::of(&bc_loss)?, adam(rate))?;
        self.target_actor.weights_mut().ema_update(self.actor.network.weights(), *self.config.actor_ema_rate)?;

        // V(s) towards an expectile of the smaller Q̂(s, a), IQL's Eq. 5.
        let q = smaller(&self.target_critics.values(&batch.observations, &batch.actions)?)?;
        let u = (&q - self.value.network.state_values(&batch.observations)?.squeeze(0)?)?;
        let value_loss = expectile_loss(&u, *self.config.expectile)?;
        self.value.descend(&Gradients::of(&value_loss)?, adam(*self.config.value_learning_rate))?;

        // Q(s, a) towards r + γ·V(s'), IQL's Eq. 6.
        let value = self.value.network.detach();
        let next = value.state_values(&batch.next_observations)?.squeeze(0)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        let critic_loss = self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        self.critics.descend(&Gradients::of(&critic_loss)?, adam(*self.config.critic_learning_rate))?;
        self.target_critics.weights_mut().ema_update(self.critics.network.weights(), *self.config.ema_rate)?;

        let v = value.state_values(&batch.observations)?.squeeze(0)?;
        let mut metrics = numbers(&[
            &targets.mean_all()?,
            &v.mean_all()?,
            &value_loss,
            &critic_loss,
            &bc_loss,
            &(q - &v)?.mean_all()?,
        ])?;
        metrics.push(rate);
        Ok(metrics)
    }
}

impl Algorithm for AlignIql {
    fn items(&self) -> usize {
        self.context.transitions.len()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Vec<f32>> {
        let (batch, noise) = (self.context.batch(items)?, self.noise(step)?);
        self.step(step, &batch, &noise)
    }

    /// Of the EMA actor's samples the one with the largest −(Q − V)²: the constraint Q = V of the aligned policy, as a penalty.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let tensors = DiffusionPolicy::tensors(&self.target_actor, &self.target_critics, Some(&self.value.network))?;
        let choice = Choice { candidates: *self.config.candidates, value: Reduce::Min, rule: Rule::Nearest };
        Ok((PolicyConfig::Diffusion { shape: self.shape.clone(), choice }, tensors))
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("actor", &mut self.actor)
            .trained("value", &mut self.value)
            .trained("critic", &mut self.critics)
            .weights("target_actor", self.target_actor.weights_mut())
            .weights("target_critic", self.target_critics.weights_mut())
    }
}
