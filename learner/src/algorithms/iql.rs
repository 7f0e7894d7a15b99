//! IQL (Kostrikov, Nair and Levine 2021, "Offline Reinforcement Learning with Implicit Q-Learning"): a value function
//! learnt by expectile regression, and a Gaussian policy cloned from the data with advantages as weights. Equations are
//! that paper's; the networks are QUAD's (docs/deviations.md).

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;

use super::algorithm::{
    AgentError, Algorithm, Context, Definition, Hyperparameters, Metric, check_layers, numbers, read, smaller,
};
use super::gaussian::Gaussian;
use super::hyperparameters::{Positive, Quantile, Rate, Share};
use super::parts::{Parts, Trained, ensemble};
use candle_core::{DType, Result, Tensor};
use quad_policy::{AdamStep, Ensemble, EnsembleShape, Gradients, MlpConfig, PolicyConfig, Tensors, cosine_decay};
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "iql",
    settings: include_str!("../../../presets/iql.toml"),
    variant: None,
    metrics: METRICS,
    check: |table| read::<Config>(table).map(drop),
    start: |table, context| Ok(Box::new(Iql::new(read(table)?, context)?)),
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;
/// Largest weight of an action of the data.
const MOST_WEIGHT: f64 = 100.0;

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
        help: "Mean over the batch of the sum over both critics of (Q_k(s, a) − y)² (IQL's Eq. 6).",
    },
    Metric {
        name: "actor_loss",
        label: "actor loss",
        help: "Mean over the batch of −weight·log π(a|s) with weight = exp(temperature·A), at most 100 (IQL's Eq. 7).",
    },
    Metric {
        name: "advantage_mean",
        label: "",
        help: "Mean over the batch of the advantage A = min_k Q̂_k(s, a) − V(s).",
    },
    Metric { name: "weight_mean", label: "", help: "Mean over the batch of the weights in the actor's loss." },
    Metric { name: "clipped_share", label: "", help: "Share of the batch, 0 to 1, whose weight is clipped at 100." },
    Metric { name: "learning_rate", label: "", help: "The actor's learning rate; falls to 0 along a cosine." },
];

/// IQL's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    actor: MlpConfig,
    critic: MlpConfig,
    value: MlpConfig,
    /// Discount γ.
    gamma: Share,
    /// The expectile τ of the value function.
    expectile: Quantile,
    /// Inverse temperature β of the advantages.
    temperature: Positive,
    actor_learning_rate: Positive,
    critic_learning_rate: Positive,
    value_learning_rate: Positive,
    /// EMA rate of the target critics.
    ema_rate: Rate,
}

impl Hyperparameters for Config {
    fn check(&self) -> std::result::Result<(), AgentError> {
        check_layers("actor", &self.actor)?;
        check_layers("critic", &self.critic)?;
        check_layers("value", &self.value)
    }
}

/// IQL in the middle of a run.
struct Iql {
    config: Config,
    context: Context,
    /// V.
    value: Trained<Ensemble>,
    /// Q_1 and Q_2, and their EMA Q̂.
    critics: Trained<Ensemble>,
    target_critics: Ensemble,
    actor: Gaussian,
}

impl Iql {
    fn new(config: Config, context: Context) -> Result<Self> {
        let (observation_dim, action_dim) = (context.observation_dim(), context.action_dim());
        let shape = |members, action_dim, layers: &MlpConfig| EnsembleShape {
            members,
            observation_dim,
            action_dim,
            layers: layers.clone(),
            outputs: 1,
        };
        let critics = ensemble(shape(CRITICS, action_dim, &config.critic), &context, 1)?;
        Ok(Self {
            value: ensemble(shape(1, 0, &config.value), &context, 2)?,
            target_critics: critics.network.copy()?,
            critics,
            actor: Gaussian::new(&config.actor, &context, 0)?,
            config,
            context,
        })
    }
}

/// Mean of |expectile − 1(u < 0)|·u² (Eq. 5), `[]`: least where u is, by so much, as often above as below 0.
pub(super) fn expectile_loss(u: &Tensor, expectile: f32) -> Result<Tensor> {
    let expectile = f64::from(expectile);
    let side = u.lt(0f32)?.to_dtype(DType::F32)?.affine(1.0 - 2.0 * expectile, expectile)?;
    (side * u.sqr()?)?.mean_all()
}

impl Algorithm for Iql {
    fn items(&self) -> usize {
        self.context.transitions.len()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Vec<f32>> {
        let (batch, count) = (self.context.batch(items)?, step + 1);
        let adam = |rate: f32| AdamStep { rate, clip: None, count };

        // V(s) towards an expectile of the smaller Q̂(s, a), Eq. 5.
        let q = smaller(&self.target_critics.values(&batch.observations, &batch.actions)?)?;
        let u = (&q - self.value.network.state_values(&batch.observations)?.squeeze(0)?)?;
        let value_loss = expectile_loss(&u, *self.config.expectile)?;
        self.value.descend(&Gradients::of(&value_loss)?, adam(*self.config.value_learning_rate))?;

        // The policy towards actions of the data, the more so the better they are, Eq. 7.
        let value = self.value.network.detach();
        let v = value.state_values(&batch.observations)?.squeeze(0)?;
        let advantage = (&q - &v)?;
        let weight = (&advantage * f64::from(*self.config.temperature))?.exp()?;
        let clipped = weight.gt(MOST_WEIGHT)?.to_dtype(DType::F32)?;
        let weight = weight.minimum(MOST_WEIGHT)?;
        let log_probability = self.actor.log_probability(&batch.observations, &batch.actions)?;
        let actor_loss = (&weight * log_probability)?.mean_all()?.neg()?;
        let rate = *self.config.actor_learning_rate * cosine_decay(step, self.context.total_steps);
        self.actor.descend(&Gradients::of(&actor_loss)?, adam(rate))?;

        // Q(s, a) towards r + γ·V(s'), Eq. 6.
        let next = value.state_values(&batch.next_observations)?.squeeze(0)?;
        let targets = batch.target(*self.config.gamma, &next)?;
        let error = self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        let critic_loss = (error * CRITICS as f64)?;
        self.critics.descend(&Gradients::of(&critic_loss)?, adam(*self.config.critic_learning_rate))?;
        self.target_critics.weights_mut().ema_update(self.critics.network.weights(), *self.config.ema_rate)?;

        let mut metrics = numbers(&[
            &targets.mean_all()?,
            &v.mean_all()?,
            &value_loss,
            &critic_loss,
            &actor_loss,
            &advantage.mean_all()?,
            &weight.mean_all()?,
            &clipped.mean_all()?,
        ])?;
        metrics.push(rate);
        Ok(metrics)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        self.actor.policy()
    }

    fn parts(&mut self) -> Parts<'_> {
        let parts = Parts::default()
            .trained("value", &mut self.value)
            .trained("critic", &mut self.critics)
            .weights("target_critic", self.target_critics.weights_mut());
        self.actor.parts(parts)
    }
}
