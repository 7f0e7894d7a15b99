//! Diffuser (Janner, Du, Tenenbaum and Levine 2022, "Planning with Diffusion for Flexible Behavior
//! Synthesis"): a diffusion model of whole windows of actions and states, and a network that
//! predicts the return of a noisy window, by whose gradient the model's samples are pulled when the
//! policy plans. Equations are that paper's; where its authors' code does otherwise,
//! docs/deviations.md says so.

use super::batch::asked;
use super::examples::Plans;
use super::prelude::*;
use quad_nn::{
    Layout, Reverse, Scaling, Schedule, TrajectoryConfig, TrajectoryModel, TrajectoryValue, Weights,
};
use quad_policy::{DiffuserPolicy, DiffuserShape, ValueGuidance, with_first_state};
use rand::Rng;

pub(super) const DEFINITION: Definition = Definition {
    name: "diffuser",
    presets: include_str!("../../presets/diffuser.toml"),
    metrics: METRICS,
    read: |table| {
        let config = Config::read(table)?;
        let plans = Plans {
            horizon: config.network.horizon,
            gamma: *config.gamma,
            terminal_penalty: *config.terminal_penalty,
        };
        Ok(Start { columns: Columns::Plans(plans), ..start(config, Diffuser::new) })
    },
    ..Definition::PLAIN
};

const METRICS: &[Metric] = &metrics! {
    model_loss ["model loss"] held_out: "Mean over batch, steps and numbers of weight·(x⁰ − model(xᵗ, t))², with a weight above 1 on the first action and 0 on the first state, which is given.";
    first_action_loss held_out: "Mean over the batch and the dimensions of the first action of (a⁰ − predicted)², in the data's standard deviations.";
    value_loss ["value loss"] held_out: "As long as the value network learns: mean over the batch of (return − V(xᵗ, t))².";
    value_mean held_out: "As long as the value network learns: mean over the batch of V(xᵗ, t).";
    return_mean held_out: "Mean over the batch of the discounted return from a window's first step to the end of its episode, with the terminal penalty.";
};

#[derive(Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct Config {
    /// Shape of both networks.
    network: TrajectoryConfig,
    diffusion_steps: Count,
    /// Discount γ of returns.
    gamma: UnitInterval,
    /// Penalty on the reward of a step that terminates an episode.
    terminal_penalty: NotNegative,
    /// Weight of the first action in the model's loss.
    first_action_weight: Positive,
    /// Learning rate of both networks.
    learning_rate: Positive,
    /// Updates in which the value network learns, the first of a run.
    value_updates: Steps,
    /// EMA rate of the networks that plan.
    ema_rate: Rate,
    /// Steps between two updates of the target networks.
    ema_every: Steps,
    /// Step, from 0, before which an update makes the target networks copies.
    ema_start: u64,
    guidance: ValueGuidance,
    candidates: Candidates,
    /// Steps that the policy takes by one plan.
    replan_every: Count,
}

impl Config {
    fn read(table: &toml::Table) -> std::result::Result<Self, AgentError> {
        let config: Self = read(table)?;
        if let Err(error) = config.network.check() {
            check(error.field, error.value, false, error.range)?;
        }
        let (replan, ValueGuidance { steps, scale, .. }) = (*config.replan_every, config.guidance);
        let fits = replan <= config.network.horizon;
        check("replan_every", replan, fits, "at most agent.network.horizon")?;
        let (fits, range) = ((1..=1000).contains(&steps), "a whole number from 1 to 1000");
        check("guidance.steps", steps, fits, range)?;
        let fits = scale >= 0.0 && scale.is_finite();
        check("guidance.scale", scale, fits, "at least 0")?;
        Ok(config)
    }
}

networks! {
    /// The target networks plan.
    struct Networks(network: &TrajectoryConfig, init) {
        model: WithTarget<TrajectoryModel> = with_target(init, TrajectoryModel::layout, |weights| {
            TrajectoryModel::new(network.clone(), weights)
        }, network),
        value: WithTarget<TrajectoryValue> = with_target(init, TrajectoryValue::layout, |weights| {
            TrajectoryValue::new(network.clone(), weights)
        }, network),
    }
}

fn with_target<N: Weighted>(
    init: &mut Initializer<'_>,
    layout: fn(&TrajectoryConfig, usize) -> Layout,
    network: impl Fn(Weights) -> N,
    config: &TrajectoryConfig,
) -> Result<WithTarget<N>> {
    let width = init.context.action_dim() + init.context.observation_dim();
    init.network(&layout(config, width), &network)?
        .with_target(|online| Ok(network(online.weights().copy()?)))
}

struct Diffuser {
    config: Config,
    context: Context,
    schedule: Schedule,
    /// Units of the plans.
    units: Scaling,
    /// Weights of the model's loss, `[H, a + o]`.
    loss_weights: Tensor,
    networks: Networks,
}

impl Diffuser {
    fn new(config: Config, context: Context) -> Result<Self> {
        let (o, a) = (context.observation_dim(), context.action_dim());
        let horizon = config.network.horizon;
        let mut weights = vec![1.0; horizon * (a + o)];
        weights[..a].fill(*config.first_action_weight);
        weights[a..a + o].fill(0.0);
        Ok(Self {
            units: context.transitions.standard_units(),
            schedule: Schedule::new(*config.diffusion_steps, Reverse::Cosine),
            loss_weights: Tensor::from_vec(weights, (horizon, a + o), &context.device)?,
            networks: Networks::new(&config.network, &mut Initializer::new(&context))?,
            config,
            context,
        })
    }

    /// The losses of the model and, as long as it learns, of the value network, on the same noisy
    /// windows.
    fn losses(&self, step: u64, batch: &Batch) -> Result<Vec<Loss>> {
        let plans = asked(&batch.plans)?;
        let mut random = self.context.random(step);
        let epsilon = random.normal("epsilon", plans.shape())?;
        let most = *self.config.diffusion_steps as u32;
        let t = random.vector("t", |generator| {
            Ok((0..batch.size()).map(|_| generator.random_range(1..=most)).collect())
        })?;
        let noisy = self.noisy(plans, &t, &epsilon)?;
        let mut losses = vec![self.model_loss(batch, &noisy, &t)?];
        if step < *self.config.value_updates {
            losses.push(self.value_loss(batch, &noisy, &t)?);
        }
        Ok(losses)
    }

    /// xᵗ = √ᾱ_t·x⁰ + √(1 − ᾱ_t)·ε, `[B, H, a + o]`, but for the first state, which stays as it
    /// is.
    fn noisy(&self, plans: &Tensor, t: &[u32], epsilon: &Tensor) -> Result<Tensor> {
        let (signal, deviation) = self.schedule.noising(t, 1, plans.device())?;
        let noisy = (plans.broadcast_mul(&signal.unsqueeze(2)?)?
            + epsilon.broadcast_mul(&deviation.unsqueeze(2)?)?)?;
        let (a, o) = (self.context.action_dim(), self.context.observation_dim());
        let first = plans.narrow(1, 0, 1)?.squeeze(1)?;
        with_first_state(&noisy, &first.narrow(1, a, o)?)
    }

    /// The model toward the clean window, the first action above all.
    fn model_loss(&self, batch: &Batch, noisy: &Tensor, t: &[u32]) -> Result<Loss> {
        let error = (self.networks.model.clean(noisy, t)? - asked(&batch.plans)?)?.sqr()?;
        let loss = error.broadcast_mul(&self.loss_weights)?.mean_all()?;
        let a = self.context.action_dim();
        let first_action = error.narrow(1, 0, 1)?.narrow(2, 0, a)?.mean_all()?;
        Ok(Loss::new("model_loss", loss)
            .with("first_action_loss", first_action)
            .with("return_mean", asked(&batch.returns)?.mean_all()?))
    }

    /// The value network toward the return.
    fn value_loss(&self, batch: &Batch, noisy: &Tensor, t: &[u32]) -> Result<Loss> {
        let values = self.networks.value.values(noisy, t)?;
        let loss = Loss::new("value_loss", squared_error(&values, asked(&batch.returns)?)?);
        Ok(loss.with("value_mean", values.mean_all()?))
    }
}

impl Algorithm for Diffuser {
    fn phases(&self) -> Vec<u64> {
        let ends = Some(*self.config.value_updates).filter(|ends| *ends < self.context.total_steps);
        [0].into_iter().chain(ends).collect()
    }

    fn update(&mut self, step: u64, batch: &Batch) -> Result<Measured> {
        let adam = AdamStep::after(step, *self.config.learning_rate);
        let losses = self.losses(step, batch)?;
        let follows = step.is_multiple_of(*self.config.ema_every);
        let rate = if step < self.config.ema_start { 1.0 } else { *self.config.ema_rate };
        let Networks { model, value } = &mut self.networks;
        model.minimize(&losses[0].value, adam)?;
        if follows {
            model.soft_update(rate)?;
        }
        if let Some(value_loss) = losses.get(1) {
            value.minimize(&value_loss.value, adam)?;
            if follows {
                value.soft_update(rate)?;
            }
        }
        measured(&losses)
    }

    fn evaluate(&self, step: u64, batch: &Batch) -> Result<Measured> {
        measured(&self.losses(step, batch)?)
    }

    fn policy(&self) -> Result<(PolicyConfig, Tensors)> {
        let shape = DiffuserShape {
            observation_dim: self.context.observation_dim(),
            action_dim: self.context.action_dim(),
            network: self.config.network.clone(),
            diffusion_steps: *self.config.diffusion_steps,
            guidance: self.config.guidance,
            replan_every: *self.config.replan_every,
            units: self.units.clone(),
        };
        let Networks { model, value } = &self.networks;
        let tensors = DiffuserPolicy::tensors(&model.target, &value.target)?;
        let choice = Choice::best_of(*self.config.candidates);
        Ok((PolicyConfig::Diffuser { shape, choice }, tensors))
    }

    fn state_dict(&mut self) -> StateDict<'_> {
        self.networks.state_dict()
    }
}
