//! What a policy carries through an episode.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// The stream, among those of an episode's seed, that a policy draws from.
const POLICY_STREAM: u64 = 2;

/// What a policy carries through one episode. Each episode has its own, so that its outcome does
/// not depend on which other episodes share a batch with it.
pub struct EpisodeState {
    noise: ChaCha8Rng,
    /// Numbers that come before the generator's.
    given: Vec<f32>,
    /// Numbers that the policy keeps from one step to the next, such as a plan or a history; none
    /// when an episode begins.
    pub memory: Vec<f32>,
}

impl EpisodeState {
    /// Begins an episode. Its noise is a stream of the episode's seed that the environment does not
    /// use.
    pub fn new(seed: u64) -> Self {
        let mut noise = ChaCha8Rng::seed_from_u64(seed);
        noise.set_stream(POLICY_STREAM);
        Self { noise, given: Vec::new(), memory: Vec::new() }
    }

    /// Begins an episode whose first normal numbers are these, for a comparison with another
    /// implementation.
    pub fn with_noise(noise: Vec<f32>) -> Self {
        Self { given: noise, ..Self::new(0) }
    }

    /// Standard normal numbers.
    pub fn fill_normal(&mut self, out: &mut [f32]) {
        let given = self.given.len().min(out.len());
        let (first, rest) = out.split_at_mut(given);
        first.iter_mut().zip(self.given.drain(..given)).for_each(|(x, given)| *x = given);
        rest.fill_with(|| StandardNormal.sample(&mut self.noise));
    }

    /// A number in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        self.noise.random()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The environments of the evaluator draw the initial state from stream 1 of an episode's seed,
    /// the goal from stream 4.
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
