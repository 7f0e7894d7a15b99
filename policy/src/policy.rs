//! What any policy can do, whatever its kind.

use crate::error::PolicyError;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The stream, among those of an episode's seed, that action noise is drawn from.
const ACTION_STREAM: u64 = 2;
/// Widest hidden layer, most critics and most denoising steps that are believed.
const MOST: usize = u16::MAX as usize;

/// The noise that one episode's actions are drawn from. A stream for each episode: its result does not depend on which
/// other episodes shared a batch with it.
pub struct ActionNoise(ChaCha8Rng);

impl ActionNoise {
    /// The stream of an episode's seed, apart from that of the environment's initial state.
    pub fn new(episode_seed: u64) -> Self {
        let mut generator = ChaCha8Rng::seed_from_u64(episode_seed);
        generator.set_stream(ACTION_STREAM);
        Self(generator)
    }

    pub(crate) fn fill(&mut self, out: &mut [f32]) {
        out.fill_with(|| StandardNormal.sample(&mut self.0));
    }
}

/// What one call of [`Policy::act`] takes, at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Cost {
    /// Memory beside the weights, bytes.
    pub bytes: u64,
    /// Multiplications.
    pub products: u64,
}

/// A trained policy, ready to act.
pub trait Policy: Send + Sync {
    /// What kind it is, e.g. `diffusion`.
    fn kind(&self) -> &'static str;

    /// Numbers in an observation.
    fn observation_dim(&self) -> usize;

    /// Numbers in an action.
    fn action_dim(&self) -> usize;

    /// Whether it samples candidate actions, of which it takes the best.
    fn samples_candidates(&self) -> bool;

    /// What it takes to choose an action for each of so many states, which can be asked before it is too much.
    fn cost(&self, states: usize, candidates: usize) -> Cost;

    /// Chooses an action for each of n states.
    ///
    /// `observations` is `n × observation_dim`, `actions` (written) `n × action_dim`; `noise` has the stream of each
    /// state's episode. A kind that samples draws `candidates` actions per state and takes the best of them.
    ///
    /// # Errors
    /// An action or its value is not a number, or candle fails.
    fn act(
        &self,
        observations: &[f32],
        candidates: usize,
        noise: &mut [ActionNoise],
        actions: &mut [f32],
    ) -> Result<(), PolicyError>;
}

/// That a number of a shape is within 1..=[`MOST`].
pub(crate) fn check_range(field: &'static str, value: usize) -> Result<(), PolicyError> {
    if (1..=MOST).contains(&value) { Ok(()) } else { Err(PolicyError::Range { field, value }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The environments of the evaluator draw the initial state from stream 1 of an episode's seed, the goal from stream 4.
    #[test]
    fn action_noise_is_apart_from_the_initial_state_and_the_goal() {
        let mut noise = [0.0; 4];
        ActionNoise::new(7).fill(&mut noise);
        for stream in [0, 1, 4] {
            let mut generator = ChaCha8Rng::seed_from_u64(7);
            generator.set_stream(stream);
            let start: [f32; 4] = std::array::from_fn(|_| StandardNormal.sample(&mut generator));
            assert_ne!(noise, start, "stream {stream}");
        }
    }
}
