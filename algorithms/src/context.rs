//! The data and settings of a run.

use std::sync::Arc;

use candle_core::Device;
use quad_dataset::{Transitions, Window};
use quad_nn::{Precision, cosine_decay};

use super::random::{Purpose, Random, stream};

/// The data and settings of a run that an algorithm learns with.
#[derive(Clone)]
pub struct Context {
    /// Transitions in their episodes.
    pub transitions: Arc<Transitions>,
    /// Updates on the dataset alone; learning rates that decay reach 0 there.
    pub total_steps: u64,
    /// Updates with experience that follow.
    pub online_steps: u64,
    /// The steps of an example: those that are seen, and those of a chunk of actions. An agent's are
    /// those of its hyper-parameters.
    pub window: Window,
    /// Seed of initial weights and noise.
    pub seed: u64,
    /// Precision of products between hidden layers.
    pub precision: Precision,
    /// Device of all tensors.
    pub device: Device,
    /// Tensors of a golden folder that take the place of random numbers.
    #[cfg(test)]
    pub golden: Option<Arc<quad_nn::Tensors>>,
}

impl Context {
    /// Size of an observation as the networks know it, o: of all that are seen at a time.
    pub fn observation_dim(&self) -> usize {
        self.transitions.observation_dim() * self.window.history
    }

    /// Size of an action as the networks know it, a: of a whole chunk.
    pub fn action_dim(&self) -> usize {
        self.transitions.action_dim() * self.window.length
    }

    /// The share of the updates with experience that come before update number `step`; `None` in
    /// those on the dataset alone.
    pub(super) fn online_share(&self, step: u64) -> Option<f64> {
        let done = step.checked_sub(self.total_steps)?;
        Some(done as f64 / self.online_steps.max(1) as f64)
    }

    /// A factor of learning rates that falls to 0 along a cosine in the updates on the dataset alone,
    /// and is `online` in those with experience.
    pub(super) fn decay(&self, step: u64, online: f32) -> f32 {
        if step < self.total_steps { cosine_decay(step, self.total_steps) } else { online }
    }

    /// The random numbers of update number `step`.
    pub(super) fn random(&self, step: u64) -> Random {
        self.random_for(Purpose::Noise, step)
    }

    pub(super) fn random_for(&self, purpose: Purpose, count: u64) -> Random {
        Random {
            generator: stream(self.seed, purpose, count),
            device: self.device.clone(),
            #[cfg(test)]
            golden: self.golden.clone(),
        }
    }
}
