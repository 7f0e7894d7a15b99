//! QUAD's hyper-parameters: the `[agent]` table of a preset.

use crate::definition::read;
use crate::error::{AgentError, check};
use crate::hyperparameters::{Candidates, Count, NotNegative, Positive, Rate, Steps, UnitInterval};
use quad_nn::MlpConfig;
use serde::Deserialize;

/// Guidance of the policy away from the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Guidance {
    /// Q-gradients weighted by λ, the critics' agreement (Eq. 19, 24).
    Quad,
    /// Unweighted Q-gradients, λ = 1 (Eq. 8).
    Dac,
    /// No Q-gradient: behavior cloning. The critics are trained all the same.
    None,
    /// A control: Q-gradients weighted by the same λ in all samples, the user's.
    Constant,
    /// A control, strength without selection: weighted by the moving average of λ at the sample's
    /// denoising step.
    Mean,
    /// A control, distribution without selection: weighted by the λ of another sample at the same
    /// denoising step.
    Shuffled,
}

/// The action at which the critics' gradients are taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum GuidanceAt {
    /// The noisy action a^t (Eq. 8, 19).
    #[default]
    Noisy,
    /// Its denoised estimate â_0, whose Jacobian is taken as the identity (QGF).
    Denoised,
}

/// Reduction of a critic's values of several sampled next actions: the maximum in AntMaze.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum TargetReduce {
    Mean,
    Max,
}

/// The strength η of behavior cloning, the Lagrangian multiplier of Eq. 19.
#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Eta {
    /// Value at the first step.
    pub initial: NotNegative,
    /// Behavior-cloning loss b that dual ascent aims at; absent: η stays at `initial`.
    pub threshold: Option<Positive>,
    /// Step size α_η of dual ascent.
    pub rate: NotNegative,
    pub minimum: NotNegative,
    pub maximum: NotNegative,
}

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Config {
    pub actor: MlpConfig,
    pub critic: MlpConfig,
    /// Ensemble size K.
    pub critics: Count,
    pub diffusion_steps: Count,
    pub gamma: UnitInterval,
    /// Pessimism ρ of the lower confidence bound (Eq. 20).
    pub rho: NotNegative,
    pub guidance: Guidance,
    #[serde(default)]
    pub guidance_at: GuidanceAt,
    /// Temperature τ of the uncertainty weight (Eq. 24); `inf` gives λ = ν̂²/(ν̂² + δ).
    pub tau: f32,
    /// Stabilizer δ of Eq. 24, on the scale of squared normalized Q-gradients.
    pub delta: Positive,
    /// λ of guidance `constant`, and only of it.
    pub lambda: Option<UnitInterval>,
    /// Next actions sampled per next state for the target, S.
    pub samples: Count,
    pub target_reduce: TargetReduce,
    /// Actions that an evaluated policy draws in each state, N_a (Eq. 25).
    pub candidates: Candidates,
    pub eta: Eta,
    /// Adam's learning rate for the actor at the first step; decays to 0 along a cosine before
    /// online learning.
    pub actor_learning_rate: Positive,
    /// Adam's learning rate for the critics at the first step; decays likewise.
    pub critic_learning_rate: Positive,
    /// Factor of both rates online.
    pub online_rate: NotNegative,
    /// Global norm at which each network's gradient is clipped.
    pub gradient_clip: Positive,
    /// EMA rate of both target networks, α_ema.
    pub ema_rate: Rate,
    /// EMA rate of ν̂² (Eq. 23), and of λ's means with guidance `mean`.
    pub nu_ema_rate: Rate,
    /// Steps between two updates of the target actor.
    pub actor_ema_every: Steps,
    /// Step, from 0, after which the target actor is first updated.
    pub actor_ema_start: u64,
}

impl Config {
    /// Reads an `[agent]` table and checks what the types do not say.
    pub fn read(table: &toml::Table) -> Result<Self, AgentError> {
        let config: Self = read(table)?;
        let (tau, guidance) = (config.tau, config.guidance);
        check("tau", tau, tau > 0.0, "above 0 (`inf` is allowed)")?;
        let holds = guidance != Guidance::None || config.guidance_at == GuidanceAt::Noisy;
        let range = "absent where agent.guidance is `none`";
        check("guidance_at", "denoised", holds, range)?;
        let (is_constant, lambda) = (guidance == Guidance::Constant, config.lambda);
        let range = match is_constant {
            true => "given where agent.guidance is `constant`",
            false => "absent unless agent.guidance is `constant`",
        };
        let value = lambda.map_or("absent".to_owned(), |lambda| lambda.to_string());
        check("lambda", value, lambda.is_some() == is_constant, range)?;
        let [initial, least, most] =
            [config.eta.initial, config.eta.minimum, config.eta.maximum].map(|eta| *eta);
        check("eta.maximum", most, least <= most, "at least eta.minimum")?;
        let (within, range) =
            ((least..=most).contains(&initial), "between eta.minimum and eta.maximum");
        check("eta.initial", initial, within, range)?;
        Ok(config)
    }
}

/// Hyper-parameters that change no policy with this guidance: without λ those of Eq. 23 and 24, and
/// without Q-gradients those of η's dual ascent, too.
pub(super) fn unused(guidance: &str) -> &'static [&'static str] {
    match guidance {
        "dac" | "constant" => &["tau", "delta", "nu_ema_rate"],
        "none" => &["tau", "delta", "nu_ema_rate", "eta.threshold", "eta.rate"],
        _ => &[],
    }
}
