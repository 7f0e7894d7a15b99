//! The random numbers of one update, drawn before it, so that the update itself is a function of its inputs.

use super::AgentConfig;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// What one update draws.
#[derive(Clone, Debug, Default)]
pub struct StepNoise {
    /// Of the sampled next actions, `T × B × S × a`: a^T, then the reverse steps' noise from t = T down to 2.
    pub next: Vec<f32>,
    /// Denoising step of each transition, in 1..=T.
    pub t: Vec<usize>,
    /// ε of Eq. 5, `B × a`.
    pub epsilon: Vec<f32>,
}

/// The stream of an agent's noise.
pub(super) struct NoiseSource {
    generator: ChaCha8Rng,
    batch: usize,
    samples: usize,
    steps: usize,
    action_dim: usize,
}

impl NoiseSource {
    pub fn new(config: &AgentConfig, action_dim: usize, seed: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(seed);
        generator.set_stream(2);
        Self { generator, batch: config.batch_size, samples: config.samples, steps: config.diffusion_steps, action_dim }
    }

    /// Draws for the next update.
    pub fn fill(&mut self, noise: &mut StepNoise) {
        let rows = self.batch * self.action_dim;
        noise.next.resize(self.steps * self.samples * rows, 0.0);
        noise.epsilon.resize(rows, 0.0);
        noise.t.resize(self.batch, 0);
        noise.next.fill_with(|| StandardNormal.sample(&mut self.generator));
        noise.epsilon.fill_with(|| StandardNormal.sample(&mut self.generator));
        noise.t.fill_with(|| self.generator.random_range(1..=self.steps));
    }
}
