//! The shapes of the networks.

use serde::{Deserialize, Serialize};

/// Size of the sinusoidal features of a denoising step.
pub(crate) const TIME_FEATURES: usize = 16;
/// Width of the MLP that embeds them, and of its output.
pub(crate) const TIME_EMBEDDING: usize = 32;

/// Everything that fixes the shapes of actor and critics.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Architecture {
    /// Numbers in an observation s.
    pub observation_dim: usize,
    /// Numbers in an action a.
    pub action_dim: usize,
    /// Width of the three hidden layers of noise predictor and critics.
    pub hidden: usize,
    /// Ensemble size K.
    pub critics: usize,
    /// Denoising steps T.
    pub diffusion_steps: usize,
}

impl Architecture {
    /// Widths of the critics' layers: [s, a] → hidden ×3 → 1.
    pub fn critic_widths(&self) -> [usize; 5] {
        [self.observation_dim + self.action_dim, self.hidden, self.hidden, self.hidden, 1]
    }

    /// Widths of the noise predictor's trunk: [s, a^t, time embedding] → hidden ×3 → a.
    pub fn trunk_widths(&self) -> [usize; 5] {
        let input = self.observation_dim + self.action_dim + TIME_EMBEDDING;
        [input, self.hidden, self.hidden, self.hidden, self.action_dim]
    }

    /// Widths of the MLP that embeds the denoising step.
    pub fn time_widths(&self) -> [usize; 3] {
        [TIME_FEATURES, TIME_EMBEDDING, TIME_EMBEDDING]
    }
}
