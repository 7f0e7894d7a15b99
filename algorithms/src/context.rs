//! What an algorithm knows of its run, the data above all.

use std::sync::Arc;

use candle_core::{Device, Result, Tensor};
use quad_dataset::{Batch, Transitions};
use quad_nn::Precision;

use super::replay::Inputs;

/// What an algorithm has to know of a run.
#[derive(Clone)]
pub struct Context {
    /// What it learns from: transitions, their order in episodes, windows of them.
    pub transitions: Arc<Transitions>,
    /// Items per update, B.
    pub batch_size: usize,
    /// Updates of the whole run; learning rates that decay reach 0 there.
    pub total_steps: u64,
    /// Seed of initial weights and noise.
    pub seed: u64,
    /// Precision of forward passes without a gradient.
    pub precision: Precision,
    /// Where the tensors lie.
    pub device: Device,
}

impl Context {
    /// Numbers in an observation.
    pub fn observation_dim(&self) -> usize {
        self.transitions.observation_dim()
    }

    /// Numbers in an action.
    pub fn action_dim(&self) -> usize {
        self.transitions.action_dim()
    }

    /// The transitions of these numbers as tensors.
    ///
    /// # Errors
    /// Candle fails.
    pub fn batch(&self, items: &[u32]) -> Result<Minibatch> {
        self.batch_on(items, &self.device)
    }

    /// [`Self::batch`] on another device.
    pub(super) fn batch_on(&self, items: &[u32], device: &Device) -> Result<Minibatch> {
        let mut batch = Batch::default();
        self.transitions.gather(items, &mut batch);
        let rows = |numbers: &[f32]| {
            Tensor::from_slice(numbers, (items.len(), numbers.len() / items.len()), device)
        };
        let column = |numbers: &[f32]| Tensor::from_slice(numbers, items.len(), device);
        Ok(Minibatch {
            observations: rows(&batch.observations)?,
            actions: rows(&batch.actions)?,
            rewards: column(&batch.rewards)?,
            next_observations: rows(&batch.next_observations)?,
            masks: column(&batch.masks)?,
        })
    }

    /// The transitions that have a next action, or need none because the episode terminates.
    pub(super) fn items_with_next_action(&self) -> Vec<u32> {
        let (transitions, mut one) = (&self.transitions, Batch::default());
        let usable = |row: &u32| {
            transitions.gather(&[*row], &mut one);
            transitions.next_action(*row).is_some() || one.masks == [0.0]
        };
        (0..transitions.len() as u32).filter(usable).collect()
    }

    /// The actions that the data takes after these transitions, `[B, a]`; 0 at the end of an
    /// episode, where none counts.
    pub(super) fn next_actions(&self, rows: &[u32]) -> Result<Tensor> {
        let a = self.action_dim();
        let none = vec![0.0; a];
        let next = |row: &u32| self.transitions.next_action(*row).unwrap_or(&none).to_vec();
        let actions: Vec<f32> = rows.iter().flat_map(next).collect();
        Tensor::from_vec(actions, (rows.len(), a), &self.device)
    }
}

/// A batch of B transitions as tensors.
#[derive(Clone, Debug)]
pub struct Minibatch {
    /// s, `[B, o]`.
    pub observations: Tensor,
    /// a, `[B, a]`.
    pub actions: Tensor,
    /// r, `[B]`.
    pub rewards: Tensor,
    /// s', `[B, o]`.
    pub next_observations: Tensor,
    /// 0 where the episode terminated, else 1; `[B]`.
    pub masks: Tensor,
}

impl Inputs for Minibatch {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let Self { observations, actions, rewards, next_observations, masks } = self;
        vec![observations, actions, rewards, next_observations, masks]
    }
}

impl Minibatch {
    /// y = r + γ·mask·v for values v of s', `[B]`, as constants.
    ///
    /// # Errors
    /// Candle fails.
    pub fn target(&self, gamma: f32, next: &Tensor) -> Result<Tensor> {
        Ok((&self.rewards + ((next * &self.masks)? * f64::from(gamma))?)?.detach())
    }
}
