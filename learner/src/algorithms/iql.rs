//! IQL (Kostrikov, Nair and Levine 2021, "Offline Reinforcement Learning with Implicit Q-Learning"): a value function
//! learnt by expectile regression, and a Gaussian policy cloned from the data with advantages as weights. Equations are
//! that paper's; the networks are QUAD's (docs/deviations.md).

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;

use super::algorithm::{
    AgentError, Algorithm, AlgorithmError, Definition, Hyperparameters, Metric, Minibatch, Setting, check, check_count,
    check_positive, check_rate, numbers, read,
};
use super::optimiser::{Adam, AdamStep, cosine_decay, follow};
use super::random::{Purpose, stream};
use candle_core::backprop::GradStore;
use candle_core::{DType, Result, Tensor};
use quad_policy::{
    Description, Ensemble, EnsembleShape, GaussianPolicy, GaussianShape, Layout, Part, PolicyError, Tensors, Weights,
    gaussian_mean,
};
use serde::Deserialize;

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "iql",
    metrics: METRICS,
    settings: include_str!("../../../presets/iql.toml"),
    variant: None,
    read: read_config,
};

/// Critics, of whose values the smaller counts.
const CRITICS: usize = 2;
/// Largest weight of an action of the data.
const MOST_WEIGHT: f64 = 100.0;
/// Bounds of the policy's log σ.
const LOG_STD: (f32, f32) = (-5.0, 2.0);

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
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// Width of the hidden layers of all networks.
    hidden: usize,
    /// Discount γ.
    gamma: f32,
    /// The expectile τ of the value function.
    expectile: f32,
    /// Inverse temperature β of the advantages.
    temperature: f32,
    actor_learning_rate: f32,
    critic_learning_rate: f32,
    value_learning_rate: f32,
    /// EMA rate of the target critics.
    ema_rate: f32,
}

fn read_config(table: &toml::Table) -> std::result::Result<Box<dyn Hyperparameters>, AgentError> {
    let config: Config = read(table)?;
    check_count("hidden", config.hidden, 1 << 14)?;
    check("gamma", config.gamma, (0.0..=1.0).contains(&config.gamma), "in [0, 1]")?;
    check("expectile", config.expectile, config.expectile > 0.0 && config.expectile < 1.0, "between 0 and 1")?;
    check_positive("temperature", config.temperature)?;
    check_positive("actor_learning_rate", config.actor_learning_rate)?;
    check_positive("critic_learning_rate", config.critic_learning_rate)?;
    check_positive("value_learning_rate", config.value_learning_rate)?;
    check_rate("ema_rate", config.ema_rate)?;
    Ok(Box::new(config))
}

impl Hyperparameters for Config {
    fn variant(&self) -> String {
        "iql".to_owned()
    }

    fn summary(&self) -> String {
        format!("iql, expectile {}, temperature {}, {} wide", self.expectile, self.temperature, self.hidden)
    }

    fn samples_candidates(&self) -> bool {
        false
    }

    fn start(&self, setting: &Setting) -> std::result::Result<Box<dyn Algorithm>, AlgorithmError> {
        Ok(Box::new(Iql::new(self.clone(), setting.clone())?))
    }
}

/// A network with its optimiser.
struct Trained {
    network: Ensemble,
    adam: Adam,
}

/// IQL in the middle of a run.
struct Iql {
    config: Config,
    setting: Setting,
    shape: GaussianShape,
    /// V.
    value: Trained,
    /// Q_1 and Q_2, and their EMA Q̂.
    critics: Trained,
    target_critics: Ensemble,
    /// The policy's mean is its tanh.
    actor: Trained,
    /// The policy's log σ, the same in all states, `[a]`.
    log_std: Weights,
    log_std_adam: Adam,
}

impl Trained {
    fn new(shape: EnsembleShape, setting: &Setting, network: u64) -> Result<Self> {
        let (layout, mut generator) = (shape.layout(), stream(setting.seed, Purpose::Weights, network));
        let values = Weights::initial(&layout, &mut generator, &setting.device)?;
        let weights = Weights::trainable(layout, &values)?;
        Ok(Self { adam: Adam::new(&weights)?, network: Ensemble::new(shape, weights, setting.precision) })
    }

    fn descend(&mut self, gradients: &GradStore, rate: f32, count: u64) -> Result<()> {
        self.adam.step(self.network.weights_mut(), gradients, AdamStep { rate, clip: None, count })?;
        Ok(())
    }

    fn state(&self, name: &str) -> Result<Tensors> {
        let mut tensors = self.network.weights().tensors(name)?;
        tensors.extend(self.adam.tensors(self.network.weights(), name)?);
        Ok(tensors)
    }

    fn load(&mut self, tensors: &mut Tensors, name: &str) -> std::result::Result<(), PolicyError> {
        self.network.weights_mut().load(tensors, name)?;
        self.adam.load(self.network.weights(), tensors, name)
    }
}

impl Iql {
    fn new(config: Config, setting: Setting) -> Result<Self> {
        let Setting { observation_dim, action_dim, .. } = setting;
        let shape = GaussianShape { observation_dim, action_dim, hidden: config.hidden };
        let of_pairs =
            EnsembleShape { members: CRITICS, observation_dim, action_dim, hidden: config.hidden, outputs: 1 };
        let of_states = EnsembleShape { members: 1, action_dim: 0, ..of_pairs };
        let critics = Trained::new(of_pairs, &setting, 1)?;
        let log_std = Layout::new(vec![Part { name: "log_std".to_owned(), shape: vec![action_dim], offset: 0 }]);
        let log_std = Weights::trainable(log_std, &Tensor::zeros(action_dim, DType::F32, &setting.device)?)?;
        Ok(Self {
            value: Trained::new(of_states, &setting, 2)?,
            target_critics: Ensemble::new(of_pairs, critics.network.weights().copy()?, setting.precision),
            critics,
            actor: Trained::new(shape.actor(), &setting, 0)?,
            log_std_adam: Adam::new(&log_std)?,
            log_std,
            shape,
            config,
            setting,
        })
    }

    /// log π(a|s) of the batch, `[B]`.
    fn log_probability(&self, batch: &Minibatch) -> Result<Tensor> {
        let log_std = self.log_std.values().clamp(LOG_STD.0, LOG_STD.1)?;
        let error = (&batch.actions - gaussian_mean(&self.actor.network, &batch.observations)?)?;
        let square = error.broadcast_div(&log_std.exp()?)?.sqr()?;
        let half_log_2_pi = 0.5 * (2.0 * std::f64::consts::PI).ln();
        ((square * -0.5)?.broadcast_sub(&log_std)? - half_log_2_pi)?.sum(1)
    }
}

impl Algorithm for Iql {
    fn update(&mut self, step: u64, batch: &Minibatch) -> Result<Vec<f32>> {
        let Config { expectile, temperature, .. } = self.config;
        let (expectile, count) = (f64::from(expectile), step + 1);

        // V(s) towards an expectile of the smaller Q̂(s, a), Eq. 5. (A minimum would drop a NaN; zero times the sum does not.)
        let q = self.target_critics.values(&batch.observations, &batch.actions)?;
        let q = (q.min(0)? + (q.sum(0)? * 0.0)?)?;
        let u = (&q - self.value.network.state_values(&batch.observations)?.squeeze(0)?)?;
        let side = u.lt(0f32)?.to_dtype(DType::F32)?.affine(1.0 - 2.0 * expectile, expectile)?;
        let value_loss = (side * u.sqr()?)?.mean_all()?;
        self.value.descend(&value_loss.backward()?, self.config.value_learning_rate, count)?;

        // The policy towards actions of the data, the more so the better they are, Eq. 7.
        let value = self.value.network.frozen();
        let v = value.state_values(&batch.observations)?.squeeze(0)?;
        let advantage = (&q - &v)?;
        let weight = (&advantage * f64::from(temperature))?.exp()?;
        let clipped = weight.gt(MOST_WEIGHT)?.to_dtype(DType::F32)?;
        let weight = weight.minimum(MOST_WEIGHT)?;
        let actor_loss = (&weight * self.log_probability(batch)?)?.mean_all()?.neg()?;
        let rate = self.config.actor_learning_rate * cosine_decay(step, self.setting.total_steps);
        let gradients = actor_loss.backward()?;
        self.actor.descend(&gradients, rate, count)?;
        self.log_std_adam.step(&mut self.log_std, &gradients, AdamStep { rate, clip: None, count })?;

        // Q(s, a) towards r + γ·V(s'), Eq. 6.
        let next = value.state_values(&batch.next_observations)?.squeeze(0)?;
        let targets = (&batch.rewards + ((next * &batch.masks)? * f64::from(self.config.gamma))?)?;
        let error = self.critics.network.squared_error(&batch.observations, &batch.actions, &targets)?;
        let critic_loss = (error * CRITICS as f64)?;
        self.critics.descend(&critic_loss.backward()?, self.config.critic_learning_rate, count)?;
        follow(self.target_critics.weights_mut(), self.critics.network.weights(), self.config.ema_rate)?;

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

    fn policy(&self) -> Result<(Description, Tensors)> {
        Ok((Description::Gaussian(self.shape), GaussianPolicy::tensors(&self.actor.network)?))
    }

    fn state(&self) -> Result<Tensors> {
        let mut tensors = self.value.state("value.")?;
        tensors.extend(self.critics.state("critic.")?);
        tensors.extend(self.target_critics.weights().tensors("target_critic.")?);
        tensors.extend(self.actor.state("actor.")?);
        tensors.extend(self.log_std.tensors("actor.")?);
        tensors.extend(self.log_std_adam.tensors(&self.log_std, "actor.")?);
        Ok(tensors)
    }

    fn load(&mut self, tensors: &mut Tensors) -> std::result::Result<(), PolicyError> {
        self.value.load(tensors, "value.")?;
        self.critics.load(tensors, "critic.")?;
        self.target_critics.weights_mut().load(tensors, "target_critic.")?;
        self.actor.load(tensors, "actor.")?;
        self.log_std.load(tensors, "actor.")?;
        self.log_std_adam.load(&self.log_std, tensors, "actor.")
    }
}
