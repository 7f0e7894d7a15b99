//! Diffuser's planner: it denoises trajectories `[action, state] × H` from a given first state,
//! guided by the gradient of their value.

use crate::error::{PolicyError, check_dims, check_range};
use candle_core::{Device, Error, Result, Tensor, Var};
use quad_kernels::scaling::Scaling;
use quad_nn::{Reverse, Schedule, TrajectoryConfig, TrajectoryModel, TrajectoryValue, read};
use serde::{Deserialize, Serialize};

/// Bound of the denoising steps, and of the steps of guidance in each.
const MOST_STEPS: usize = 1000;

/// Trajectories denoised together, which bounds the memory of a gradient.
pub(crate) const CHUNK: usize = 32;

/// The shapes of the networks, and the planning.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiffuserShape {
    /// Length of an observation s.
    pub observation_dim: usize,
    /// Length of an action a.
    pub action_dim: usize,
    /// Shape of both networks.
    pub network: TrajectoryConfig,
    /// Denoising steps T.
    pub diffusion_steps: usize,
    /// Guidance toward large values.
    pub guidance: ValueGuidance,
    /// Actions executed of one plan, from 1 to the horizon.
    pub replan_every: usize,
    /// Normalization of observations and actions, beside the file's scaling.
    pub units: Scaling,
}

/// Guidance of plans by the gradient of their value.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValueGuidance {
    /// Gradient steps in each denoising step.
    pub steps: usize,
    /// Factor of the gradient, beside the variance of the denoising step.
    pub scale: f32,
    /// Number of last denoising steps without guidance.
    pub stop: usize,
}

impl DiffuserShape {
    /// Length of a step of a trajectory, [action, state].
    pub fn width(&self) -> usize {
        self.action_dim + self.observation_dim
    }

    pub(crate) fn check(&self) -> crate::error::Result<()> {
        check_dims(self.observation_dim, self.action_dim)?;
        let checked = self.network.check();
        checked.map_err(|of| PolicyError::Range { field: of.field, value: of.value })?;
        check_range("diffusion_steps", self.diffusion_steps, MOST_STEPS)?;
        check_range("guidance.steps", self.guidance.steps, MOST_STEPS)?;
        check_range("replan_every", self.replan_every, self.network.horizon)
    }

    /// Numbers held of a trajectory while a gradient is taken: all layers, some of them unfolded, and
    /// their gradients.
    pub(crate) fn floats(&self) -> u128 {
        let network = &self.network;
        let levels = network.lengths().into_iter().zip(network.widths());
        let of_level = |(steps, wide): (usize, usize)| 100 * steps * wide.max(self.width());
        let of_blocks: usize = levels.map(of_level).sum();
        let inner = network
            .attention
            .map_or(0, |of| of.heads * of.width * (16 * network.horizon + 4 * of.width));
        (of_blocks + inner * 2 * network.multipliers.len()) as u128
    }
}

/// Diffuser's networks and noise schedule.
pub struct Planner {
    pub(crate) shape: DiffuserShape,
    schedule: Schedule,
    model: TrajectoryModel,
    value: TrajectoryValue,
}

/// Trajectories `x [B, H, a + o]` with the first state replaced by `states [B, o]`.
pub fn with_first_state(x: &Tensor, states: &Tensor) -> Result<Tensor> {
    let (horizon, action_dim) = (x.dim(1)?, x.dim(2)? - states.dim(1)?);
    let action = x.narrow(1, 0, 1)?.narrow(2, 0, action_dim)?;
    let first = Tensor::cat(&[&action, &states.unsqueeze(1)?], 2)?;
    Tensor::cat(&[&first, &x.narrow(1, 1, horizon - 1)?], 1)
}

impl Planner {
    /// A planner with networks of the shape.
    pub fn new(shape: DiffuserShape, model: TrajectoryModel, value: TrajectoryValue) -> Self {
        let schedule = Schedule::new(shape.diffusion_steps, Reverse::Cosine);
        Self { shape, schedule, model, value }
    }

    /// Plans in n states with `observations`, `n × observation_dim`, in the networks' units.
    ///
    /// `noise`, `T × n × plans × H × (a + o)`, is standard normal: first the noisy trajectories, then
    /// the noise of the reverse steps from t = T down to 2. Returns the first actions of each plan,
    /// `n × plans × replan_every × a`, and its value at the last denoising step, `n × plans`.
    pub fn plan(
        &self,
        observations: &[f32],
        noise: &[f32],
    ) -> crate::error::Result<(Vec<f32>, Vec<f32>)> {
        let shape = &self.shape;
        let (o, horizon) = (shape.observation_dim, shape.network.horizon);
        let (states, size) = (observations.len() / o, horizon * shape.width());
        let all = noise.len() / shape.diffusion_steps;
        let (rows, mut actions, mut values) = (all / size, Vec::new(), Vec::new());
        for from in (0..rows).step_by(CHUNK) {
            let count = CHUNK.min(rows - from);
            let of_row = |row: usize| &observations[row * states / rows * o..][..o];
            let first: Vec<f32> = (from..from + count).flat_map(of_row).copied().collect();
            let first = Tensor::from_vec(first, (count, o), &Device::Cpu)?;
            let noise = |step: usize| {
                let numbers = &noise[step * all + from * size..][..count * size];
                Tensor::from_slice(numbers, (count, horizon, shape.width()), &Device::Cpu)
            };
            let (plans, of_plans) = self.denoise(&first, noise)?;
            let taken = plans.narrow(1, 0, shape.replan_every)?;
            let taken = taken.narrow(2, 0, shape.action_dim)?.contiguous()?;
            read(&taken, |taken: &[f32]| actions.extend_from_slice(taken))?;
            values.extend(of_plans);
        }
        Ok((actions, values))
    }

    /// The reverse process of trajectories with these first states, `[B, o]`. Returns the
    /// trajectories, `[B, H, a + o]`, and their values.
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
                // The variance, and so the guidance, is 0.
                values = self.value.values(&x, &all)?.to_vec1()?;
            } else if t > stop {
                for _ in 0..steps {
                    let scale = f64::from(scale * self.schedule.variance(t));
                    let along = (self.gradient(&x, &all)? * scale)?;
                    x = with_first_state(&(x + along)?, first)?;
                }
            }
            let z = match t {
                1 => None,
                _ => Some(noise(self.shape.diffusion_steps - t + 1)?),
            };
            let clean = self.model.clean(&x, &all)?;
            let next = self.schedule.reverse_to_clean(t, &x, &clean, z.as_ref())?;
            x = with_first_state(&next, first)?;
        }
        Ok((x, values))
    }

    /// The gradient of each trajectory's value, as constants.
    fn gradient(&self, x: &Tensor, t: &[u32]) -> Result<Tensor> {
        let x = Var::from_tensor(x)?;
        let gradient = self.value.values(&x, t)?.sum_all()?.backward()?.remove(&x);
        let missing = || Error::Msg("no gradient reaches the trajectories".into());
        gradient.map(|gradient| gradient.detach()).ok_or_else(missing)
    }
}
