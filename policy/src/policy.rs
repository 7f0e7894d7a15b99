//! What any policy can do, whatever its kind.

use crate::choice::Choice;
use crate::error::PolicyError;
use crate::precision::Precision;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The stream, among those of an episode's seed, that a policy draws from.
const POLICY_STREAM: u64 = 2;
/// Widest hidden layer, most critics and most denoising steps that are believed.
const MOST: usize = u16::MAX as usize;

/// What a policy carries through one episode. Each episode has its own, so that its outcome does not depend on which other
/// episodes share a batch with it.
pub struct EpisodeState {
    noise: ChaCha8Rng,
    /// Numbers that the policy keeps from one step to the next, such as a plan or a history; none when an episode begins.
    pub memory: Vec<f32>,
}

impl EpisodeState {
    /// At an episode's beginning. Its noise is the stream of the episode's seed that is apart from those of the environment.
    pub fn new(seed: u64) -> Self {
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        noise.set_stream(POLICY_STREAM);
        Self { noise, memory: Vec::new() }
    }

    /// Standard normal numbers.
    pub(crate) fn fill_normal(&mut self, out: &mut [f32]) {
        out.fill_with(|| StandardNormal.sample(&mut self.noise));
    }

    /// A number in [0, 1).
    pub(crate) fn uniform(&mut self) -> f64 {
        self.noise.random()
    }
}

/// A trained policy, ready to act.
pub trait Policy: Send + Sync {
    /// Numbers in an observation.
    fn observation_dim(&self) -> usize;

    /// Numbers in an action.
    fn action_dim(&self) -> usize;

    /// The precision that its actions are computed in, which need not be the one that was asked for.
    fn precision(&self) -> Precision;

    /// How it chooses among the actions that it draws; none if it draws none.
    fn choice(&self) -> Option<Choice> {
        None
    }

    /// Lets it choose in another way.
    ///
    /// # Errors
    /// It draws no actions, it lacks a network that this takes, or a number is out of range.
    fn choose(&mut self, _choice: Choice) -> Result<(), PolicyError> {
        Err(PolicyError::NoCandidates)
    }

    /// Memory beside the weights that one call of [`Self::act`] takes for so many states at most, bytes. It can be asked
    /// before it is too much.
    fn memory(&self, states: usize) -> u64;

    /// What it carries through the episode of that seed, at its beginning.
    fn begin(&self, seed: u64) -> EpisodeState {
        EpisodeState::new(seed)
    }

    /// Acts in each of n states.
    ///
    /// `observations` is `n × observation_dim`, `actions` (written) `n × action_dim`; `states` has what the policy carries
    /// through each state's episode.
    ///
    /// # Errors
    /// An action or its value is not a number, or candle fails.
    fn act(&self, observations: &[f32], states: &mut [EpisodeState], actions: &mut [f32]) -> Result<(), PolicyError>;
}

/// That a number of a shape is within 1..=65535.
pub(crate) fn check_range(field: &'static str, value: usize) -> Result<(), PolicyError> {
    if (1..=MOST).contains(&value) { Ok(()) } else { Err(PolicyError::Range { field, value }) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The environments of the evaluator draw the initial state from stream 1 of an episode's seed, the goal from stream 4.
    #[test]
    fn a_policy_s_noise_is_apart_from_the_initial_state_and_the_goal() {
        let mut noise = [0.0; 4];
        EpisodeState::new(7).fill_normal(&mut noise);
        for stream in [0, 1, 4] {
            let mut generator = ChaCha8Rng::seed_from_u64(7);
            generator.set_stream(stream);
            let start: [f32; 4] = std::array::from_fn(|_| StandardNormal.sample(&mut generator));
            assert_ne!(noise, start, "stream {stream}");
        }
    }
}
