//! Noisy actions, from which a noise predictor learns to denoise.

use candle_core::{Device, Result, Shape, Tensor};
use quad_policy::{NoiseShape, Schedule};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard normal numbers.
pub(super) fn normal(shape: impl Into<Shape>, generator: &mut impl Rng, device: &Device) -> Result<Tensor> {
    let shape = shape.into();
    let numbers: Vec<f32> = (0..shape.elem_count()).map(|_| StandardNormal.sample(generator)).collect();
    Tensor::from_vec(numbers, shape, device)
}

/// How the actions of a batch are made noisy.
pub(super) struct Denoising {
    /// Denoising step of each, in 1..=T, `[B]`.
    pub t: Vec<u32>,
    /// The noise ε that is to be predicted, `[B, a]`.
    pub epsilon: Tensor,
}

/// Noisy actions.
pub(super) struct Noisy {
    /// a^t = √ᾱ_t·a + √(1 − ᾱ_t)·ε, `[B, a]`.
    pub actions: Tensor,
    /// √(1 − ᾱ_t), in all columns of a row, `[B, a]`.
    pub deviation: Tensor,
    /// t, `[B]`.
    pub t: Tensor,
}

impl Denoising {
    /// For a batch of so many actions; each t is as likely.
    pub fn draw(shape: &NoiseShape, batch: usize, generator: &mut impl Rng, device: &Device) -> Result<Self> {
        let epsilon = normal((batch, shape.action_dim), generator, device)?;
        let t = (0..batch).map(|_| generator.random_range(1..=shape.diffusion_steps as u32)).collect();
        Ok(Self { t, epsilon })
    }

    /// Actions `[B, a]`, made noisy.
    pub fn noisy(&self, schedule: &Schedule, actions: &Tensor) -> Result<Noisy> {
        let device = actions.device();
        let (signal, deviation) = schedule.noising(&self.t, actions.dim(1)?, device)?;
        let actions = ((actions * signal)? + (&self.epsilon * &deviation)?)?;
        Ok(Noisy { actions, deviation, t: Tensor::from_slice(&self.t, self.t.len(), device)? })
    }
}
