//! What the algorithms that train a diffusion policy share: a noise predictor with its EMA, the random numbers of a reverse
//! chain, and noisy actions to learn to denoise.

use super::context::Context;
use super::trained::{Trained, initial};
use candle_core::{Device, Result, Shape, Tensor};
use quad_policy::{NoisePredictor, NoiseShape, Schedule};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

/// A noise predictor to be trained, at its beginning, whose weights decay so much; and a copy that is to follow it.
pub(super) fn noise_predictor(
    shape: NoiseShape,
    decay: f32,
    context: &Context,
    network: u64,
) -> Result<(Trained<NoisePredictor>, NoisePredictor)> {
    let weights = initial(&shape.layout(), context, network)?;
    let target = NoisePredictor::new(shape.clone(), weights.copy()?, context.precision);
    Ok((Trained::new(NoisePredictor::new(shape, weights, context.precision), decay)?, target))
}

/// Standard normal numbers.
fn normal(shape: impl Into<Shape>, generator: &mut impl Rng, device: &Device) -> Result<Tensor> {
    let shape = shape.into();
    let numbers: Vec<f32> = (0..shape.elem_count()).map(|_| StandardNormal.sample(generator)).collect();
    Tensor::from_vec(numbers, shape, device)
}

/// The noise of so many sampled actions, `[T, rows, a]`: a^T, then that of the reverse steps from t = T down to 2.
pub(super) fn chain_noise(
    shape: &NoiseShape,
    rows: usize,
    generator: &mut impl Rng,
    device: &Device,
) -> Result<Tensor> {
    normal((shape.diffusion_steps, rows, shape.action_dim), generator, device)
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
