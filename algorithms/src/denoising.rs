//! Noisy actions, from which a noise predictor learns to denoise.

use super::inputs::Inputs;
use candle_core::{Result, Tensor};
use quad_nn::Schedule;

/// Denoising steps and noise for the actions of a batch.
#[derive(Clone)]
pub(super) struct Denoising {
    /// t in 1..=T, `[B]`.
    pub t: Tensor,
    /// ε, `[B, a]`.
    pub epsilon: Tensor,
    /// √ᾱ_t, in all columns of a row, `[B, a]`.
    signal: Tensor,
    /// √(1 − ᾱ_t), `[B, a]`.
    pub deviation: Tensor,
}

impl Inputs for Denoising {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let Self { t, epsilon, signal, deviation } = self;
        vec![t, epsilon, signal, deviation]
    }
}

impl Denoising {
    pub fn new(t: &[u32], epsilon: Tensor, schedule: &Schedule) -> Result<Self> {
        let (signal, deviation) = schedule.noising(t, epsilon.dim(1)?, epsilon.device())?;
        let t = Tensor::new(t, epsilon.device())?;
        Ok(Self { t, epsilon, signal, deviation })
    }

    /// √ᾱ_t·a + √(1 − ᾱ_t)·ε of actions a, all `[B, a]`.
    pub fn noisy(&self, actions: &Tensor) -> Result<Tensor> {
        (actions * &self.signal)? + (&self.epsilon * &self.deviation)?
    }

    /// The estimate of the clean actions in noisy ones, given a predicted noise ε: (a^t − √(1 −
    /// ᾱ_t)·ε)/√ᾱ_t, clipped to ±1, all `[B, a]`.
    pub fn clean(&self, noisy: &Tensor, predicted: &Tensor) -> Result<Tensor> {
        ((noisy - (predicted * &self.deviation)?)? / &self.signal)?.clamp(-1f32, 1f32)
    }
}
