//! Diffuser's planner: it denoises trajectories `[action, state] × H` from a given first state,
//! guided by the gradient of their value.

use crate::error::{PolicyError, check_range};
use candle_core::{Device, Error, Result, Tensor, Var};
use quad_kernels::scaling::Scaling;
use quad_nn::{
    MAX_DIM, Schedule, TrajectoryConfig, TrajectoryError, TrajectoryModel, TrajectoryValue, read,
};
use serde::{Deserialize, Serialize};

/// Bound of the denoising steps, and of the steps of guidance in each.
const MOST_STEPS: usize = 1000;

/// Windows that are worked on together; what a gradient takes is kept of so many at most.
pub(crate) const CHUNK: usize = 32;

/// What a planner is beside its weights.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffuserShape {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Both networks.
    pub network: TrajectoryConfig,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// How plans are pulled toward large returns.
    pub guidance: ValueGuidance,
    /// Steps of an episode that are taken by one plan, from 1 to the horizon.
    pub replan_every: usize,
    /// The units in which the networks see observations and actions, beside those of the file's own
    /// scaling.
    pub units: Scaling,
}

/// How plans are pulled toward large returns.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValueGuidance {
    /// Steps along the value's gradient in each denoising step.
    pub steps: usize,
    /// What the gradient is multiplied by, beside the variance of the denoising step.
    pub scale: f32,
    /// The last denoising steps, so many, have none.
    pub stop: usize,
}

impl DiffuserShape {
    /// Numbers of a step in a window: [action, state].
    pub fn width(&self) -> usize {
        self.action_dim + self.observation_dim
    }

    pub(crate) fn check(&self) -> std::result::Result<(), PolicyError> {
        check_range("observation_dim", self.observation_dim, MAX_DIM)?;
        check_range("action_dim", self.action_dim, MAX_DIM)?;
        self.network
            .check()
            .map_err(|TrajectoryError { field, value, .. }| PolicyError::Range { field, value })?;
        check_range("diffusion_steps", self.diffusion_steps, MOST_STEPS)?;
        check_range("guidance.steps", self.guidance.steps, MOST_STEPS)?;
        check_range("replan_every", self.replan_every, self.network.horizon)
    }

    /// Numbers that are kept of a window while a gradient is taken: those of the networks' layers,
    /// some of them unfolded, with their gradients.
    pub(crate) fn numbers(&self) -> u128 {
        let TrajectoryConfig { horizon, attention, .. } = &self.network;
        let levels = self.network.lengths().into_iter().zip(self.network.widths());
        let of_blocks =
            levels.map(|(steps, wide)| 100 * steps * wide.max(self.width())).sum::<usize>();
        let inner = attention.map_or(0, |of| of.heads * of.width * (16 * horizon + 4 * of.width));
        (of_blocks + inner * 2 * self.network.multipliers.len()) as u128
    }
}

/// Diffuser's networks and noise schedule.
pub struct Planner {
    shape: DiffuserShape,
    schedule: Schedule,
    model: TrajectoryModel,
    value: TrajectoryValue,
}

/// Windows `[B, H, a + o]` whose first state is this one, `[B, o]`.
///
/// # Errors
/// Candle fails.
pub fn with_first_state(windows: &Tensor, states: &Tensor) -> Result<Tensor> {
    let (horizon, action_dim) = (windows.dim(1)?, windows.dim(2)? - states.dim(1)?);
    let first = Tensor::cat(
        &[&windows.narrow(1, 0, 1)?.narrow(2, 0, action_dim)?, &states.unsqueeze(1)?],
        2,
    )?;
    Tensor::cat(&[&first, &windows.narrow(1, 1, horizon - 1)?], 1)
}

impl Planner {
    /// The networks are those of the shape.
    pub fn new(shape: DiffuserShape, model: TrajectoryModel, value: TrajectoryValue) -> Self {
        Self { schedule: Schedule::cosine(shape.diffusion_steps), shape, model, value }
    }

    /// Plans in n states, whose observations are `n × observation_dim`; `noise` is `T × n × plans ×
    /// H × (a + o)`, standard normal: first the windows as they begin, then the noise of the
    /// reverse steps from t = T down to 2. Gives the first actions of each plan, `n × plans ×
    /// replan_every × a`, and the value of each as its last guidance finds it; all in the networks'
    /// units.
    ///
    /// # Errors
    /// Candle fails.
    pub fn plan(
        &self,
        observations: &[f32],
        noise: &[f32],
    ) -> std::result::Result<(Vec<f32>, Vec<f32>), PolicyError> {
        let DiffuserShape {
            observation_dim: o, action_dim: a, diffusion_steps, replan_every, ..
        } = self.shape;
        let (horizon, states) = (self.shape.network.horizon, observations.len() / o);
        let size = horizon * self.shape.width();
        let all = noise.len() / diffusion_steps;
        let (rows, mut actions, mut values) = (all / size, Vec::new(), Vec::new());
        for from in (0..rows).step_by(CHUNK) {
            let count = CHUNK.min(rows - from);
            let of_row = |row: usize| &observations[row * states / rows * o..][..o];
            let first: Vec<f32> = (from..from + count).flat_map(of_row).copied().collect();
            let first = Tensor::from_vec(first, (count, o), &Device::Cpu)?;
            let noise = |step: usize| {
                let numbers = &noise[step * all + from * size..][..count * size];
                Tensor::from_slice(numbers, (count, horizon, self.shape.width()), &Device::Cpu)
            };
            let (plans, worth) = self.denoise(&first, noise)?;
            let taken = plans.narrow(1, 0, replan_every)?.narrow(2, 0, a)?.contiguous()?;
            read(&taken, |taken: &[f32]| actions.extend_from_slice(taken))?;
            values.extend(worth);
        }
        Ok((actions, values))
    }

    /// The whole reverse process of windows with these first states, `[B, o]`. Gives the windows,
    /// `[B, H, a + o]`, and their values.
    fn denoise(
        &self,
        first: &Tensor,
        noise: impl Fn(usize) -> Result<Tensor>,
    ) -> Result<(Tensor, Vec<f32>)> {
        let ValueGuidance { steps, scale, stop } = self.shape.guidance;
        let mut x = with_first_state(&noise(0)?, first)?;
        let mut values = Vec::new();
        for t in (1..=self.shape.diffusion_steps).rev() {
            let all = vec![t as u32; first.dim(0)?];
            if t == 1 {
                // There is no variance, and so no guidance: all of its steps would find this.
                values = self.value.values(&x, &all)?.to_vec1()?;
            } else if t > stop {
                for _ in 0..steps {
                    let along =
                        (self.gradient(&x, &all)? * f64::from(scale * self.schedule.variance(t)))?;
                    x = with_first_state(&(x + along)?, first)?;
                }
            }
            let z = if t > 1 { Some(noise(self.shape.diffusion_steps - t + 1)?) } else { None };
            x = with_first_state(
                &self.schedule.reverse_to_clean(t, &x, &self.model.clean(&x, &all)?, z.as_ref())?,
                first,
            )?;
        }
        Ok((x, values))
    }

    /// The gradient of each window's value with respect to the window, as constants.
    fn gradient(&self, x: &Tensor, t: &[u32]) -> Result<Tensor> {
        let x = Var::from_tensor(x)?;
        let gradient = self.value.values(&x, t)?.sum_all()?.backward()?.remove(&x);
        gradient
            .map(|gradient| gradient.detach())
            .ok_or_else(|| Error::Msg("no gradient reaches the windows".into()))
    }
}
