//! Noisy actions, from which a noise predictor learns to denoise.

use super::replay::Inputs;
use candle_core::{Device, Result, Shape, Tensor};
use quad_nn::{ContinuousNoise, Schedule};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};

/// Standard normal numbers.
pub(super) fn normal(
    shape: impl Into<Shape>,
    generator: &mut impl Rng,
    device: &Device,
) -> Result<Tensor> {
    let shape = shape.into();
    let numbers: Vec<f32> =
        (0..shape.elem_count()).map(|_| StandardNormal.sample(generator)).collect();
    Tensor::from_vec(numbers, shape, device)
}

/// How the actions of a batch are made noisy.
#[derive(Clone)]
pub(super) struct Denoising {
    /// Denoising step t of each, in 1..=T, `[B]`.
    pub t: Tensor,
    /// The noise ε that is to be predicted, `[B, a]`.
    pub epsilon: Tensor,
    /// √ᾱ_t, in all columns of a row, `[B, a]`.
    signal: Tensor,
    /// √(1 − ᾱ_t), likewise.
    pub deviation: Tensor,
}

impl Inputs for Denoising {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        vec![&mut self.t, &mut self.epsilon, &mut self.signal, &mut self.deviation]
    }
}

impl Denoising {
    /// By this t and ε for each action.
    pub fn new(t: &[u32], epsilon: Tensor, schedule: &Schedule) -> Result<Self> {
        let (signal, deviation) = schedule.noising(t, epsilon.dim(1)?, epsilon.device())?;
        Ok(Self { t: Tensor::new(t, epsilon.device())?, epsilon, signal, deviation })
    }

    /// √ᾱ_t·a + √(1 − ᾱ_t)·ε of actions a, all `[B, a]`.
    pub fn noisy(&self, actions: &Tensor) -> Result<Tensor> {
        (actions * &self.signal)? + (&self.epsilon * &self.deviation)?
    }
}

/// How the actions of a batch are made noisy in continuous time.
pub(super) struct NoiseInTime {
    /// Time of each, within [0, 1], `[B]`.
    pub t: Vec<f64>,
    /// The noise ε that is to be predicted, `[B, a]`.
    pub epsilon: Tensor,
}

impl NoiseInTime {
    /// α_t·a + σ_t·ε of actions a, all `[B, a]`.
    pub fn noisy(&self, actions: &Tensor) -> Result<Tensor> {
        let column = |of: fn(ContinuousNoise) -> f64| {
            let numbers =
                self.t.iter().map(|t| of(ContinuousNoise::at(*t)) as f32).collect::<Vec<_>>();
            Tensor::from_vec(numbers, (self.t.len(), 1), actions.device())
        };
        let signal = actions.broadcast_mul(&column(|noise| noise.signal)?)?;
        signal + self.epsilon.broadcast_mul(&column(|noise| noise.deviation)?)?
    }
}
