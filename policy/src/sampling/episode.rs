//! The state of a policy in an episode.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The policy's stream of an episode's seed.
const POLICY_STREAM: u64 = 2;

/// The state of a policy in one episode, which makes the outcome independent of other episodes in
/// the batch.
pub struct EpisodeState {
    noise: ChaCha8Rng,
    /// Numbers that come before the generator's.
    given: Vec<f32>,
    /// The last observations, oldest first, of a policy that sees several.
    pub(crate) seen: Vec<f32>,
    /// The actions of a chunk that are still to be executed.
    pub(crate) chunk: Vec<f32>,
}

impl EpisodeState {
    /// The state at the beginning of an episode. The environment does not use the stream of its
    /// noise.
    pub fn new(seed: u64) -> Self {
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        noise.set_stream(POLICY_STREAM);
        let [given, seen, chunk] = [const { Vec::new() }; 3];
        Self { noise, given, seen, chunk }
    }

    /// Begins an episode whose first normal numbers are these, for a comparison with another
    /// implementation.
    pub fn with_noise(noise: Vec<f32>) -> Self {
        let mut state = Self::new(0);
        state.given = noise;
        state
    }

    /// Fills `out` with standard normal numbers.
    pub fn fill_normal(&mut self, out: &mut [f32]) {
        let given = self.given.len().min(out.len());
        let (first, rest) = out.split_at_mut(given);
        let given = self.given.drain(..given);
        first.iter_mut().zip(given).for_each(|(x, given)| *x = given);
        rest.fill_with(|| StandardNormal.sample(&mut self.noise));
    }

    /// Draws from U[0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.noise.random()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The evaluator draws the initial state from stream 1, and a maze's goal and start from 4 and 5.
    #[test]
    fn the_noise_differs_from_streams_of_the_environment() {
        let mut noise = [0.0; 4];
        EpisodeState::new(7).fill_normal(&mut noise);
        for stream in [0, 1, 4, 5] {
            let mut generator = ChaCha8Rng::seed_from_u64(7);
            generator.set_stream(stream);
            let start: [f32; 4] = std::array::from_fn(|_| StandardNormal.sample(&mut generator));
            assert_ne!(noise, start, "stream {stream}");
        }
    }
}
