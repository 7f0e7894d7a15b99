//! Batches of examples as tensors, and what losses compute of them.

use candle_core::{Result, Tensor};
use quad_nn::{Ensemble, squared_error};

use super::losses::Loss;
use super::replay::Inputs;

/// B transitions, or B windows of up to h of them. It is drawn on the CPU; an [`Agent`](super::Agent)
/// copies it to its device.
#[derive(Clone, Debug)]
pub struct Batch {
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
    /// a', the data's next actions, `[B, a]`; 0 at the end of an episode.
    pub next_actions: Option<Tensor>,
    /// Discounted rewards to the end of the episode, `[B]`.
    pub returns: Option<Tensor>,
    /// [action, state] of the next H steps in standard units, `[B, H, a + o]`.
    pub plans: Option<Tensor>,
    /// Numbers of the examples among all.
    pub indices: Vec<u32>,
}

impl Inputs for Batch {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let mut tensors = vec![
            &mut self.observations,
            &mut self.actions,
            &mut self.rewards,
            &mut self.next_observations,
            &mut self.masks,
        ];
        tensors.extend(&mut self.within);
        tensors.extend(&mut self.next_actions);
        tensors.extend(&mut self.returns);
        tensors.extend(&mut self.plans);
        tensors
    }
}

impl Batch {
    /// Number of examples, B.
    pub(super) fn size(&self) -> usize {
        self.indices.len()
    }

    /// y = r + γ·mask·v for values v of s', `[B]`, as constants.
    pub(super) fn target(&self, gamma: f32, next: &Tensor) -> Result<Tensor> {
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
        Loss::critics(self.squared_error(critics, targets)?, targets)
    }

    /// Mean over critics and batch of (Q_k(s, a) − y)², `[]`, for constants y, `[B]`.
    pub(super) fn squared_error(&self, critics: &Ensemble, targets: &Tensor) -> Result<Tensor> {
        squared_error(&self.values(critics)?, &targets.detach())
    }
}

/// A column that the algorithm's table asks for.
pub(super) fn asked(column: &Option<Tensor>) -> Result<&Tensor> {
    column.as_ref().ok_or_else(|| candle_core::Error::msg("a column of the batch is missing"))
}
