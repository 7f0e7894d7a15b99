//! Hyper-parameters of the update: the `[agent]` table of a preset.

use quad_policy::{Architecture, Precision};
use serde::{Deserialize, Serialize};

/// What pulls the policy away from the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Guidance {
    /// Q-gradients weighted by λ, the critics' agreement (Eq. 19, 24).
    Quad,
    /// Unweighted Q-gradients, λ = 1 (Eq. 8).
    Dac,
    /// No Q-gradient: behaviour cloning. The critics are trained all the same.
    None,
}

/// How the values of several sampled next actions become one target.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TargetReduce {
    /// Their mean (locomotion).
    Mean,
    /// Their maximum (AntMaze).
    Max,
}

/// The strength η of behaviour cloning, the Lagrangian multiplier of Eq. 19.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EtaConfig {
    /// Value at the first step.
    pub initial: f32,
    /// Behaviour-cloning loss b that dual ascent aims at; absent: η stays at `initial`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub threshold: Option<f32>,
    /// Step size α_η of dual ascent.
    pub rate: f32,
    /// Smallest η.
    pub minimum: f32,
    /// Largest η.
    pub maximum: f32,
}

/// Everything that decides what one update does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AgentConfig {
    /// Width of the hidden layers of actor and critics.
    pub hidden: usize,
    /// Ensemble size K.
    pub critics: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// Transitions per update, B.
    pub batch_size: usize,
    /// Discount γ.
    pub gamma: f32,
    /// Pessimism ρ of the lower confidence bound (Eq. 20).
    pub rho: f32,
    /// What guides the actor.
    pub guidance: Guidance,
    /// Temperature τ of the uncertainty weight (Eq. 24); `inf` gives λ = ν̂²/(ν̂² + δ).
    pub tau: f32,
    /// Stabiliser δ of Eq. 24, on the scale of squared normalised Q-gradients.
    pub delta: f32,
    /// Next actions sampled per next state for the target.
    pub samples: usize,
    /// How their values are combined.
    pub target_reduce: TargetReduce,
    /// Behaviour-cloning strength.
    pub eta: EtaConfig,
    /// Adam's learning rate for the actor at the first step; decays to 0 along a cosine.
    pub actor_learning_rate: f32,
    /// The same for the critics.
    pub critic_learning_rate: f32,
    /// Global norm at which each network's gradient is clipped.
    pub gradient_clip: f32,
    /// EMA rate of both target networks, α_ema.
    pub ema_rate: f32,
    /// EMA rate of ν̂² (Eq. 23).
    pub nu_ema_rate: f32,
    /// Updates between two EMA steps of the target actor.
    pub actor_ema_every: u64,
    /// Updates after which the target actor starts to follow.
    pub actor_ema_start: u64,
    /// Arithmetic of what no gradient is taken of: the sampled next actions, and the target critics' values.
    #[serde(default)]
    pub precision: Precision,
}

/// A hyper-parameter outside its range.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("agent.{field} is {value}, but must be {range}")]
pub struct ConfigError {
    /// Name within the `[agent]` table.
    pub field: &'static str,
    /// What it was.
    pub value: String,
    /// What it may be.
    pub range: &'static str,
}

impl AgentConfig {
    /// The shapes of the networks for an environment's dimensions.
    pub fn architecture(&self, observation_dim: usize, action_dim: usize) -> Architecture {
        Architecture {
            observation_dim,
            action_dim,
            hidden: self.hidden,
            critics: self.critics,
            diffusion_steps: self.diffusion_steps,
        }
    }

    /// Checks every range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let count = |field, value: usize, most: usize| {
            check(field, value, (1..=most).contains(&value), "a whole number from 1 on, of reasonable size")
        };
        count("hidden", self.hidden, 1 << 14)?;
        count("critics", self.critics, 1 << 10)?;
        count("diffusion_steps", self.diffusion_steps, 1 << 10)?;
        count("batch_size", self.batch_size, 1 << 20)?;
        count("samples", self.samples, 1 << 10)?;
        check("gamma", self.gamma, (0.0..=1.0).contains(&self.gamma), "in [0, 1]")?;
        check("rho", self.rho, self.rho >= 0.0 && self.rho.is_finite(), "at least 0")?;
        check("tau", self.tau, self.tau > 0.0, "above 0 (`inf` is allowed)")?;
        check("delta", self.delta, self.delta > 0.0 && self.delta.is_finite(), "above 0")?;
        let positive = |field, value: f32| check(field, value, value > 0.0 && value.is_finite(), "above 0");
        positive("actor_learning_rate", self.actor_learning_rate)?;
        positive("critic_learning_rate", self.critic_learning_rate)?;
        positive("gradient_clip", self.gradient_clip)?;
        let rate = |field, value: f32| check(field, value, value > 0.0 && value <= 1.0, "in (0, 1]");
        rate("ema_rate", self.ema_rate)?;
        rate("nu_ema_rate", self.nu_ema_rate)?;
        check("actor_ema_every", self.actor_ema_every, self.actor_ema_every > 0, "at least 1")?;
        let eta = &self.eta;
        check("eta.minimum", eta.minimum, eta.minimum >= 0.0, "at least 0")?;
        check("eta.maximum", eta.maximum, eta.maximum >= eta.minimum, "at least eta.minimum")?;
        let allowed = (eta.minimum..=eta.maximum).contains(&eta.initial);
        check("eta.initial", eta.initial, allowed, "between eta.minimum and eta.maximum")?;
        check("eta.rate", eta.rate, eta.rate >= 0.0 && eta.rate.is_finite(), "at least 0")?;
        let threshold = eta.threshold.unwrap_or(1.0);
        check("eta.threshold", threshold, threshold > 0.0 && threshold.is_finite(), "above 0")
    }
}

fn check(field: &'static str, value: impl ToString, holds: bool, range: &'static str) -> Result<(), ConfigError> {
    if holds {
        return Ok(());
    }
    Err(ConfigError { field, value: value.to_string(), range })
}
