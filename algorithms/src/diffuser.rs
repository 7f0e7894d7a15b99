//! Diffuser (Janner, Du, Tenenbaum and Levine 2022, "Planning with Diffusion for Flexible Behavior
//! Synthesis"): a diffusion model of whole windows of actions and states, and a network that
//! predicts the return of a noisy window, by whose gradient the model's samples are pulled when the
//! policy plans. Equations are that paper's; where its authors' code does otherwise,
//! docs/deviations.md says so.

#[cfg(test)]
#[allow(clippy::unwrap_used)]
#[path = "golden/diffuser.rs"]
mod golden;
mod windows;

use super::algorithm::{AgentError, Algorithm, AlgorithmError, Loss, Measured, check, measured};
use super::context::Context;
use super::definition::{Definition, Metric, Reporting, metrics, read};
use super::denoising::normal;
use super::hyperparameters::{Candidates, Count, NotNegative, Positive, Rate, Steps, UnitInterval};
use super::parts::Parts;
use super::random::{Purpose, stream};
use super::train_state::{TrainState, initial};
use candle_core::{Result, Tensor};
use candle_nn::loss::mse;
use quad_nn::{
    AdamStep, Layout, Schedule, Tensors, TrajectoryConfig, TrajectoryError, TrajectoryModel,
    TrajectoryValue, Weighted, Weights,
};
use quad_policy::{
    Choice, DiffuserPolicy, DiffuserShape, PolicyConfig, ValueGuidance, with_first_state,
};
use rand::Rng;
use serde::Deserialize;
use windows::{Batch, Windows};

/// What the learner has to know of it.
pub(super) const DEFINITION: Definition = Definition {
    name: "diffuser",
    settings: include_str!("../../presets/diffuser.toml"),
    metrics: METRICS,
    report: Reporting { counts: &["candidates"], ..Reporting::PLAIN },
    check: |table| read::<Config>(table)?.check(),
    start: |table, context| Ok(Box::new(Diffuser::new(read(table)?, context)?)),
};

const METRICS: &[Metric] = &metrics! {
    model_loss ["model loss"] held_out: "Mean over batch, steps and numbers of weight·(x⁰ − model(xᵗ, t))², with a weight above 1 on the first action and 0 on the first state, which is given.";
    first_action_loss held_out: "Mean over the batch and the dimensions of the first action of (a⁰ − predicted)², in the data's standard deviations.";
    value_loss ["value loss"] held_out: "As long as the value network learns: mean over the batch of (return − V(xᵗ, t))².";
    value_mean held_out: "As long as the value network learns: mean over the batch of V(xᵗ, t).";
    return_mean held_out: "Mean over the batch of the discounted return from a window's first step to the end of its episode, with the terminal penalty.";
};

/// Diffuser's hyper-parameters: the `[agent]` table of a preset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// Both networks.
    network: TrajectoryConfig,
    /// Denoising steps T.
    diffusion_steps: Count,
    /// Discount γ of returns.
    gamma: UnitInterval,
    /// Taken off the reward of a step that terminates an episode.
    terminal_penalty: NotNegative,
    /// Weight of the first action in the model's loss.
    first_action_weight: Positive,
    /// Learning rate of both networks.
    learning_rate: Positive,
    /// Updates in which the value network learns, the first of a run.
    value_updates: Steps,
    /// EMA rate of the networks that plan.
    ema_rate: Rate,
    /// They follow in updates whose number, from 0, is a multiple of this …
    ema_every: Steps,
    /// … and are copies before this.
    ema_start: u64,
    guidance: ValueGuidance,
    /// Plans that an evaluated policy draws in each state.
    candidates: Candidates,
    /// Steps that it takes by one plan.
    replan_every: Count,
}

impl Config {
    fn check(&self) -> std::result::Result<(), AgentError> {
        let network =
            |TrajectoryError { field, value, range }| check(field, value, false, range).err();
        if let Some(error) = self.network.check().err().and_then(network) {
            return Err(error);
        }
        let (replan, ValueGuidance { steps, scale, .. }) = (*self.replan_every, self.guidance);
        check("replan_every", replan, replan <= self.network.horizon, "at most the horizon")?;
        check(
            "guidance.steps",
            steps,
            (1..=1000).contains(&steps),
            "a whole number from 1 to 1000",
        )?;
        check("guidance.scale", scale, scale >= 0.0 && scale.is_finite(), "at least 0")
    }
}

/// The random numbers of one update.
struct Noise {
    /// Denoising step of each window, in 1..=T, `[B]`.
    t: Vec<u32>,
    /// `[B, H, a + o]`.
    epsilon: Tensor,
}

/// Diffuser in the middle of a run.
struct Diffuser {
    config: Config,
    context: Context,
    windows: Windows,
    schedule: Schedule,
    /// Weights of the model's loss, `[H, a + o]`.
    weights: Tensor,
    model: TrainState<TrajectoryModel>,
    value: TrainState<TrajectoryValue>,
    /// Their EMAs, which plan.
    target_model: TrajectoryModel,
    target_value: TrajectoryValue,
}

/// A network that learns, and the constant one that follows it.
fn networks<N: Weighted>(
    layout: &Layout,
    of: impl Fn(Weights) -> N,
    context: &Context,
    number: u64,
) -> Result<(TrainState<N>, N)> {
    let weights = initial(layout, context, number)?;
    let target = of(weights.copy()?);
    Ok((TrainState::new(of(weights), 0.0)?, target))
}

impl Diffuser {
    fn new(config: Config, context: Context) -> std::result::Result<Self, AlgorithmError> {
        config.check()?;
        let (o, a) = (context.observation_dim(), context.action_dim());
        let network = &config.network;
        let windows =
            Windows::new(&context, network.horizon, *config.gamma, *config.terminal_penalty)?;
        let mut weights = vec![1.0; network.horizon * (a + o)];
        weights[..a].fill(*config.first_action_weight);
        weights[a..a + o].fill(0.0);
        let of_model = |weights| TrajectoryModel::new(network.clone(), weights);
        let of_value = |weights| TrajectoryValue::new(network.clone(), weights);
        let (model, target_model) =
            networks(&TrajectoryModel::layout(network, a + o), of_model, &context, 0)?;
        let (value, target_value) =
            networks(&TrajectoryValue::layout(network, a + o), of_value, &context, 1)?;
        Ok(Self {
            schedule: Schedule::cosine(*config.diffusion_steps),
            weights: Tensor::from_vec(weights, (network.horizon, a + o), &context.device)?,
            windows,
            model,
            value,
            target_model,
            target_value,
            config,
            context,
        })
    }

    fn noise(&self, step: u64) -> Result<Noise> {
        let mut generator = stream(self.context.seed, Purpose::Noise, step);
        let width = self.context.action_dim() + self.context.observation_dim();
        let shape = (self.context.batch_size, self.config.network.horizon, width);
        let epsilon = normal(shape, &mut generator, &self.context.device)?;
        let most = *self.config.diffusion_steps as u32;
        Ok(Noise { t: (0..shape.0).map(|_| generator.random_range(1..=most)).collect(), epsilon })
    }

    /// xᵗ = √ᾱ_t·x⁰ + √(1 − ᾱ_t)·ε, but for the first state, which stays as it is.
    fn noisy(&self, windows: &Tensor, noise: &Noise) -> Result<Tensor> {
        let (signal, deviation) = self.schedule.noising(&noise.t, 1, windows.device())?;
        let noisy = (windows.broadcast_mul(&signal.unsqueeze(2)?)?
            + noise.epsilon.broadcast_mul(&deviation.unsqueeze(2)?)?)?;
        let (a, o) = (self.context.action_dim(), self.context.observation_dim());
        with_first_state(&noisy, &windows.narrow(1, 0, 1)?.narrow(2, a, o)?.squeeze(1)?)
    }

    /// Update number `step`, from 0: both networks on the same noisy windows.
    fn step(&mut self, step: u64, batch: &Batch, noise: &Noise) -> Result<Measured> {
        let adam = AdamStep::after(step, *self.config.learning_rate);
        let noisy = self.noisy(&batch.windows, noise)?;
        let follow = step.is_multiple_of(*self.config.ema_every);
        let rate = if step < self.config.ema_start { 1.0 } else { *self.config.ema_rate };

        let model_loss = self.model_loss(batch, &noisy, noise)?;
        self.model.minimize(&model_loss.value, adam)?;
        if follow {
            self.target_model.soft_update(&self.model.network, rate)?;
        }
        if step >= *self.config.value_updates {
            return measured(&[model_loss]);
        }

        let value_loss = self.value_loss(batch, &noisy, noise)?;
        self.value.minimize(&value_loss.value, adam)?;
        if follow {
            self.target_value.soft_update(&self.value.network, rate)?;
        }
        measured(&[model_loss, value_loss])
    }

    /// The model: the clean window, the first action above all.
    fn model_loss(&self, batch: &Batch, noisy: &Tensor, noise: &Noise) -> Result<Loss> {
        let error = (self.model.network.clean(noisy, &noise.t)? - &batch.windows)?.sqr()?;
        let loss = Loss::new("model_loss", error.broadcast_mul(&self.weights)?.mean_all()?);
        let first_action =
            error.narrow(1, 0, 1)?.narrow(2, 0, self.context.action_dim())?.mean_all()?;
        Ok(loss
            .with("first_action_loss", first_action)
            .with("return_mean", batch.returns.mean_all()?))
    }

    /// The value network: the return, as far as the noise lets it be seen.
    fn value_loss(&self, batch: &Batch, noisy: &Tensor, noise: &Noise) -> Result<Loss> {
        let values = self.value.network.values(noisy, &noise.t)?;
        Ok(Loss::new("value_loss", mse(&values, &batch.returns)?)
            .with("value_mean", values.mean_all()?))
    }
}

impl Algorithm for Diffuser {
    fn items(&self, _: usize) -> usize {
        self.windows.count()
    }

    fn phases(&self) -> Vec<u64> {
        let ends = Some(*self.config.value_updates).filter(|ends| *ends < self.context.total_steps);
        [0].into_iter().chain(ends).collect()
    }

    fn update(&mut self, step: u64, items: &[u32]) -> Result<Measured> {
        let batch = self.windows.batch(items, &self.context.device)?;
        let noise = self.noise(step)?;
        self.step(step, &batch, &noise)
    }

    fn evaluate(&self, step: u64, items: &[u32]) -> Result<Measured> {
        let (batch, noise) = (self.windows.batch(items, &self.context.device)?, self.noise(step)?);
        let noisy = self.noisy(&batch.windows, &noise)?;
        let mut losses = vec![self.model_loss(&batch, &noisy, &noise)?];
        if step < *self.config.value_updates {
            losses.push(self.value_loss(&batch, &noisy, &noise)?);
        }
        measured(&losses)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let shape = DiffuserShape {
            observation_dim: self.context.observation_dim(),
            action_dim: self.context.action_dim(),
            network: self.config.network.clone(),
            diffusion_steps: *self.config.diffusion_steps,
            guidance: self.config.guidance,
            replan_every: *self.config.replan_every,
            units: self.windows.units().clone(),
        };
        let tensors = DiffuserPolicy::tensors(&self.target_model, &self.target_value)?;
        Ok((
            PolicyConfig::Diffuser { shape, choice: Choice::best_of(*self.config.candidates) },
            tensors,
        ))
    }

    fn parts(&mut self) -> Parts<'_> {
        Parts::default()
            .trained("model", &mut self.model)
            .trained("value", &mut self.value)
            .weights("target_model", self.target_model.weights_mut())
            .weights("target_value", self.target_value.weights_mut())
    }
}
