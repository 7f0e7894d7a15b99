//! QUAD's hyper-parameters: the `[agent]` table of a preset.

use crate::algorithms::algorithm::{self, AgentError, check, check_count, check_positive, check_rate};
use quad_policy::Choice;
use serde::Deserialize;

/// What pulls the policy away from the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Guidance {
    /// Q-gradients weighted by λ, the critics' agreement (Eq. 19, 24).
    Quad,
    /// Unweighted Q-gradients, λ = 1 (Eq. 8).
    Dac,
    /// No Q-gradient: behaviour cloning. The critics are trained all the same.
    None,
}

/// How a critic's values of several sampled next actions become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum TargetReduce {
    /// Their mean (locomotion).
    Mean,
    /// Their maximum (AntMaze).
    Max,
}

/// The strength η of behaviour cloning, the Lagrangian multiplier of Eq. 19.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Eta {
    /// Value at the first step.
    pub initial: f32,
    /// Behaviour-cloning loss b that dual ascent aims at; absent: η stays at `initial`.
    pub threshold: Option<f32>,
    /// Step size α_η of dual ascent.
    pub rate: f32,
    /// Smallest η.
    pub minimum: f32,
    /// Largest η.
    pub maximum: f32,
}

/// Everything that decides what one update does.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Quad {
    /// Width of the hidden layers of actor and critics.
    pub hidden: usize,
    /// Ensemble size K.
    pub critics: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
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
    /// Next actions sampled per next state for the target, S.
    pub samples: usize,
    /// How their values are combined.
    pub target_reduce: TargetReduce,
    /// Actions that an evaluated policy draws in each state, N_a (Eq. 25).
    pub candidates: u32,
    /// Behaviour-cloning strength.
    pub eta: Eta,
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
    /// The target actor follows in updates whose number, from 0, is a multiple of this …
    pub actor_ema_every: u64,
    /// … and above this.
    pub actor_ema_start: u64,
}

/// Reads and checks the table.
pub(super) fn read(table: &toml::Table) -> Result<Quad, AgentError> {
    let config: Quad = algorithm::read(table)?;
    config.validate()?;
    Ok(config)
}

impl Quad {
    fn validate(&self) -> Result<(), AgentError> {
        check_count("hidden", self.hidden, 1 << 14)?;
        check_count("critics", self.critics, 1 << 10)?;
        check_count("diffusion_steps", self.diffusion_steps, 1000)?;
        check_count("samples", self.samples, 1 << 10)?;
        check_count("candidates", self.candidates as usize, Choice::MOST_CANDIDATES as usize)?;
        check("gamma", self.gamma, (0.0..=1.0).contains(&self.gamma), "in [0, 1]")?;
        check("rho", self.rho, self.rho >= 0.0 && self.rho.is_finite(), "at least 0")?;
        check("tau", self.tau, self.tau > 0.0, "above 0 (`inf` is allowed)")?;
        check_positive("delta", self.delta)?;
        check_positive("actor_learning_rate", self.actor_learning_rate)?;
        check_positive("critic_learning_rate", self.critic_learning_rate)?;
        check_positive("gradient_clip", self.gradient_clip)?;
        check_rate("ema_rate", self.ema_rate)?;
        check_rate("nu_ema_rate", self.nu_ema_rate)?;
        check("actor_ema_every", self.actor_ema_every, self.actor_ema_every > 0, "at least 1")?;
        let Eta { initial, threshold, rate, minimum, maximum } = self.eta;
        check("eta.minimum", minimum, minimum >= 0.0, "at least 0")?;
        check("eta.maximum", maximum, maximum >= minimum, "at least eta.minimum")?;
        check("eta.initial", initial, (minimum..=maximum).contains(&initial), "between eta.minimum and eta.maximum")?;
        check("eta.rate", rate, rate >= 0.0 && rate.is_finite(), "at least 0")?;
        threshold.map_or(Ok(()), |threshold| check_positive("eta.threshold", threshold))
    }
}
