//! The context of a run, and its mini-batches as tensors.

use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use quad_dataset::{Batch, Transitions, Window};
use quad_nn::{Ensemble, Precision, cosine_decay, squared_error};

use super::error::AlgorithmError;
use super::inputs::Inputs;
use super::losses::Loss;
use super::random::{Purpose, Random, stream};

/// The data and settings of a run that an algorithm learns with.
#[derive(Clone)]
pub struct Context {
    /// Transitions in their episodes.
    pub transitions: Arc<Transitions>,
    /// Examples per update, B.
    pub batch_size: usize,
    /// Updates on the dataset alone; learning rates that decay reach 0 there.
    pub total_steps: u64,
    /// Updates with experience that follow.
    pub online_steps: u64,
    /// The steps of an example: those that are seen, and those of a chunk of actions.
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

    /// The windows that begin with these transitions as tensors.
    pub fn batch(&self, indices: &[u32]) -> Result<Minibatch> {
        self.batch_on(indices, &self.device)
    }

    pub(super) fn batch_on(&self, indices: &[u32], device: &Device) -> Result<Minibatch> {
        let mut batch = Batch::default();
        self.transitions.gather_windows(indices, self.window, &mut batch);
        let rows = |numbers: &[f32]| {
            Tensor::from_slice(numbers, (indices.len(), numbers.len() / indices.len()), device)
        };
        let column = |numbers: &[f32]| Tensor::from_slice(numbers, indices.len(), device);
        Ok(Minibatch {
            observations: rows(&batch.observations)?,
            actions: rows(&batch.actions)?,
            rewards: column(&batch.rewards)?,
            next_observations: rows(&batch.next_observations)?,
            masks: column(&batch.masks)?,
            within: self.within(&batch.steps, device)?,
        })
    }

    fn within(&self, steps: &[usize], device: &Device) -> Result<Option<Tensor>> {
        if self.window.length == 1 {
            return Ok(None);
        }
        let (a, width) = (self.transitions.action_dim(), self.action_dim());
        let of_example = |n: usize| (0..width).map(move |i| f32::from(u8::from(i < n * a)));
        let within = Vec::from_iter(steps.iter().copied().flat_map(of_example));
        Tensor::from_vec(within, (steps.len(), width), device).map(Some)
    }

    /// The transitions that have a next action, or need none because the episode terminates.
    pub(super) fn with_next_action(&self) -> std::result::Result<Vec<u32>, AlgorithmError> {
        let (transitions, mut one) = (&self.transitions, Batch::default());
        let usable = |row: &u32| {
            transitions.gather(&[*row], &mut one);
            transitions.next_action(*row).is_some() || one.masks == [0.0]
        };
        let rows = Vec::from_iter((0..transitions.len() as u32).filter(usable));
        if rows.is_empty() { Err(AlgorithmError::NoNextAction) } else { Ok(rows) }
    }

    /// The actions that the data takes after these transitions, `[B, a]`; 0 at the end of an
    /// episode.
    pub(super) fn next_actions(&self, rows: &[u32]) -> Result<Tensor> {
        let a = self.action_dim();
        let none = vec![0.0; a];
        let next = |row: &u32| self.transitions.next_action(*row).unwrap_or(&none).to_vec();
        let actions: Vec<f32> = rows.iter().flat_map(next).collect();
        Tensor::from_vec(actions, (rows.len(), a), &self.device)
    }
}

/// The elements of `of` with these indices.
pub(super) fn select(of: &[u32], indices: &[u32]) -> Vec<u32> {
    indices.iter().map(|index| of[*index as usize]).collect()
}

/// A batch of B transitions, or of B windows of up to h of them.
#[derive(Clone, Debug)]
pub struct Minibatch {
    /// s, `[B, o]`.
    pub observations: Tensor,
    /// a, `[B, a]`: the actions of a chunk, the last of which is repeated where the episode ends
    /// before.
    pub actions: Tensor,
    /// r, `[B]`: the discounted sum over a window.
    pub rewards: Tensor,
    /// s', `[B, o]`: the state after a window.
    pub next_observations: Tensor,
    /// 0 where a step of a window is terminal, else 1, times γ for each step after the first; `[B]`.
    pub masks: Tensor,
    /// With chunks: 1 for actions within the episode, else 0; `[B, a]`.
    pub within: Option<Tensor>,
}

impl Inputs for Minibatch {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let Self { observations, actions, rewards, next_observations, masks, within } = self;
        let mut tensors = vec![observations, actions, rewards, next_observations, masks];
        tensors.extend(within);
        tensors
    }
}

impl Minibatch {
    /// y = r + γ·mask·v for values v of s', `[B]`, as constants.
    pub fn target(&self, gamma: f32, next: &Tensor) -> Result<Tensor> {
        Ok((&self.rewards + ((next * &self.masks)? * f64::from(gamma))?)?.detach())
    }

    /// `predicted` within the episode and `truth` beyond its end, where nothing is to be learned; all
    /// `[B, a]`.
    pub(super) fn within_episodes(&self, predicted: Tensor, truth: &Tensor) -> Result<Tensor> {
        match &self.within {
            Some(within) => (predicted * within)? + (truth * within.affine(-1.0, 1.0)?)?,
            None => Ok(predicted),
        }
    }

    /// Q_k(s, a), `[K, B]`.
    pub(super) fn values(&self, critics: &Ensemble) -> Result<Tensor> {
        self.values_at(critics, &self.actions)
    }

    /// Q_k of other actions in s, of which each s has the same number.
    pub(super) fn values_at(&self, critics: &Ensemble, actions: &Tensor) -> Result<Tensor> {
        critics.values(&self.observations, actions)
    }

    /// Q_k of actions in s', of which each s' has the same number.
    pub(super) fn next_values(&self, critics: &Ensemble, actions: &Tensor) -> Result<Tensor> {
        critics.values(&self.next_observations, actions)
    }

    /// The loss of critics that is the mean over critics and batch of (Q_k(s, a) − y)².
    pub(super) fn critic_loss(&self, critics: &Ensemble, targets: &Tensor) -> Result<Loss> {
        Loss::of_critics(self.squared_error(critics, targets)?, targets)
    }

    /// Mean over critics and batch of (Q_k(s, a) − y)², `[]`, for constants y, `[B]`.
    pub(super) fn squared_error(&self, critics: &Ensemble, targets: &Tensor) -> Result<Tensor> {
        squared_error(&self.values(critics)?, &targets.detach())
    }
}
