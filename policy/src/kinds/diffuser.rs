//! Diffuser's policy (Janner et al. 2022, Algorithm 1): it denoises trajectories `[action, state] × H`
//! from the current state, guided by the gradient of their value, and takes the first actions of
//! the one with the largest value.

use crate::error::{PolicyError, Result, check_dims, check_numbers, check_range};
use crate::policy::{Policy, Samples};
use crate::sampling::choice::{Choice, Rule};
use crate::sampling::episode::EpisodeState;
use candle_core::{Device, Error, Tensor, Var};
use quad_kernels::scaling::Scaling;
use quad_nn::{
    Precision, Reverse, Schedule, Tensors, TrajectoryConfig, TrajectoryModel, TrajectoryValue,
    Weighted, Weights, f32_bytes, read,
};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Prefixes of the tensors' names.
pub(crate) const MODEL: &str = "model.";
pub(crate) const VALUE: &str = "value.";

/// Bound of the denoising steps, and of the steps of guidance in each.
const MOST_STEPS: usize = 1000;

/// Trajectories denoised together, which bounds the memory of a gradient.
const CHUNK: usize = 32;

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

    fn check(&self) -> Result<()> {
        check_dims(self.observation_dim, self.action_dim)?;
        if let Err(error) = self.network.check() {
            let (field, value) = (error.field, error.value);
            return Err(PolicyError::Range { field, value });
        }
        check_range("diffusion_steps", self.diffusion_steps, MOST_STEPS)?;
        check_range("guidance.steps", self.guidance.steps, MOST_STEPS)?;
        check_range("replan_every", self.replan_every, self.network.horizon)
    }

    /// Numbers held of a trajectory while a gradient is taken: all layers, some of them unfolded, and
    /// their gradients.
    fn floats(&self) -> u128 {
        let network = &self.network;
        let levels = network.lengths().into_iter().zip(network.widths());
        let level = |(steps, wide): (usize, usize)| 100 * steps * wide.max(self.width());
        let blocks: usize = levels.map(level).sum();
        let attention = network.attention.map_or(0, |inner| {
            inner.heads * inner.width * (16 * network.horizon + 4 * inner.width)
        });
        (blocks + attention * 2 * network.multipliers.len()) as u128
    }
}

/// Trajectories `x [B, H, a + o]` with the first state replaced by `states [B, o]`.
pub fn with_first_state(x: &Tensor, states: &Tensor) -> candle_core::Result<Tensor> {
    let (horizon, action_dim) = (x.dim(1)?, x.dim(2)? - states.dim(1)?);
    let action = x.narrow(1, 0, 1)?.narrow(2, 0, action_dim)?;
    let first = Tensor::cat(&[&action, &states.unsqueeze(1)?], 2)?;
    Tensor::cat(&[&first, &x.narrow(1, 1, horizon - 1)?], 1)
}

/// Diffuser's policy. An action is a chunk: the first `replan_every` actions of a plan.
pub struct DiffuserPolicy {
    choice: Choice,
    /// Shared with copies that have another choice.
    planner: Arc<Planner>,
}

struct Planner {
    shape: DiffuserShape,
    schedule: Schedule,
    model: TrajectoryModel,
    value: TrajectoryValue,
}

impl DiffuserPolicy {
    /// The tensors of a policy's file.
    pub fn tensors(
        model: &TrajectoryModel,
        value: &TrajectoryValue,
    ) -> candle_core::Result<Tensors> {
        let mut tensors = model.weights().tensors(MODEL)?;
        tensors.extend(value.weights().tensors(VALUE)?);
        Ok(tensors)
    }

    pub(crate) fn load(
        shape: DiffuserShape,
        choice: Choice,
        tensors: &mut Tensors,
    ) -> Result<Self> {
        shape.check()?;
        let (config, width) = (&shape.network, shape.width());
        let model = Weights::take(TrajectoryModel::layout(config, width), tensors, MODEL)?;
        let value = Weights::take(TrajectoryValue::layout(config, width), tensors, VALUE)?;
        let planner = Planner {
            schedule: Schedule::new(shape.diffusion_steps, Reverse::Cosine),
            model: TrajectoryModel::new(config.clone(), model),
            value: TrajectoryValue::new(config.clone(), value),
            shape,
        };
        Self::new(Arc::new(planner), choice)
    }

    fn new(planner: Arc<Planner>, choice: Choice) -> Result<Self> {
        choice.check()?;
        match choice.rule {
            Rule::Nearest => Err(PolicyError::NoValue),
            _ if choice.guidance != 0.0 => Err(PolicyError::NoGuidance),
            _ => Ok(Self { choice, planner }),
        }
    }

    fn shape(&self) -> &DiffuserShape {
        &self.planner.shape
    }

    /// Plans in n states with `observations`, `n × observation_dim`. Returns the first actions of
    /// each plan, `n × plans × replan_every × a`, and its value at the last denoising step, `n × plans`.
    /// The noise is T × H × (a + o) for each plan: first the noisy trajectory, then that of the
    /// reverse steps from t = T down to 2.
    fn plan(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
    ) -> Result<(Vec<f32>, Vec<f32>)> {
        let (shape, n) = (self.shape(), states.len());
        let (o, horizon) = (shape.observation_dim, shape.network.horizon);
        let (plans, size) = (self.choice.candidates as usize, horizon * shape.width());
        let mut noise = vec![0.0; shape.diffusion_steps * n * plans * size];
        for (i, state) in states.iter_mut().enumerate() {
            for step in 0..shape.diffusion_steps {
                let first = (step * n + i) * plans * size;
                state.fill_normal(&mut noise[first..][..plans * size]);
            }
        }
        let (mut actions, mut values) = (Vec::new(), Vec::new());
        for from in (0..n * plans).step_by(CHUNK) {
            let count = CHUNK.min(n * plans - from);
            let state = |row: usize| &observations[row / plans * o..][..o];
            let first: Vec<f32> = (from..from + count).flat_map(state).copied().collect();
            let first = Tensor::from_vec(first, (count, o), &Device::Cpu)?;
            let noise = |step: usize| {
                let numbers = &noise[(step * n * plans + from) * size..][..count * size];
                Tensor::from_slice(numbers, (count, horizon, shape.width()), &Device::Cpu)
            };
            let (trajectories, chunk_values) = self.planner.denoise(&first, noise)?;
            let taken = trajectories.narrow(1, 0, shape.replan_every)?;
            let taken = taken.narrow(2, 0, shape.action_dim)?.contiguous()?;
            read(&taken, |taken: &[f32]| actions.extend_from_slice(taken))?;
            values.extend(chunk_values);
        }
        check_numbers("an action of a plan", &actions)?;
        check_numbers("the value of a plan", &values)?;
        Ok((actions, values))
    }
}

impl Planner {
    /// The reverse process of trajectories with these first states, `[B, o]`. Returns the
    /// trajectories, `[B, H, a + o]`, and their values.
    fn denoise(
        &self,
        first: &Tensor,
        noise: impl Fn(usize) -> candle_core::Result<Tensor>,
    ) -> candle_core::Result<(Tensor, Vec<f32>)> {
        let ValueGuidance { steps, scale, stop } = self.shape.guidance;
        let mut x = with_first_state(&noise(0)?, first)?;
        let mut values = Vec::new();
        for t in (1..=self.shape.diffusion_steps).rev() {
            let times = vec![t as u32; first.dim(0)?];
            if t == 1 {
                // The variance, and so the guidance, is 0.
                values = self.value.values(&x, &times)?.to_vec1()?;
            } else if t > stop {
                for _ in 0..steps {
                    let scale = f64::from(scale * self.schedule.variance(t));
                    let along = (self.gradient(&x, &times)? * scale)?;
                    x = with_first_state(&(x + along)?, first)?;
                }
            }
            let z = match t {
                1 => None,
                _ => Some(noise(self.shape.diffusion_steps - t + 1)?),
            };
            let clean = self.model.clean(&x, &times)?;
            let next = self.schedule.reverse_to_clean(t, &x, &clean, z.as_ref())?;
            x = with_first_state(&next, first)?;
        }
        Ok((x, values))
    }

    /// The gradient of each trajectory's value, as constants.
    fn gradient(&self, x: &Tensor, t: &[u32]) -> candle_core::Result<Tensor> {
        let x = Var::from_tensor(x)?;
        let gradient = self.value.values(&x, t)?.sum_all()?.backward()?.remove(&x);
        let missing = || Error::Msg("no gradient reaches the trajectories".into());
        Ok(gradient.ok_or_else(missing)?.detach())
    }
}

impl Policy for DiffuserPolicy {
    fn observation_dim(&self) -> usize {
        self.shape().observation_dim
    }

    fn action_dim(&self) -> usize {
        self.shape().replan_every * self.shape().action_dim
    }

    fn precision(&self) -> Precision {
        Precision::F32
    }

    fn choice(&self) -> Option<Choice> {
        Some(self.choice)
    }

    fn with_choice(&self, choice: Choice) -> Result<Box<dyn Policy>> {
        Ok(Box::new(Self::new(self.planner.clone(), choice)?))
    }

    fn memory(&self, states: usize) -> u64 {
        let rows = states as u128 * u128::from(self.choice.candidates);
        let trajectory = (self.shape().network.horizon * self.shape().width()) as u128;
        let noise = trajectory * self.shape().diffusion_steps as u128;
        let drawn = rows * (noise + 2 * self.action_dim() as u128 + 2);
        let observations = 2 * (states * self.shape().observation_dim) as u128;
        f32_bytes(drawn + observations + rows.min(CHUNK as u128) * self.shape().floats())
    }

    fn noise(&self) -> Vec<usize> {
        let (shape, plans) = (self.shape(), self.choice.candidates as usize);
        let (steps, horizon) = (shape.diffusion_steps, shape.network.horizon);
        vec![steps, plans, horizon, shape.width()]
    }

    fn act(
        &self,
        observations: &[f32],
        states: &mut [EpisodeState],
        actions: &mut [f32],
    ) -> Result<()> {
        let (planned, values) = self.plan(observations, states)?;
        self.choice.take(&planned, &values, states, actions)
    }

    fn sample(&self, observations: &[f32], states: &mut [EpisodeState]) -> Result<Samples> {
        let (actions, values) = self.plan(observations, states)?;
        Ok(Samples { actions, values })
    }
}

#[cfg(test)]
mod tests;
