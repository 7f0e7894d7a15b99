//! Which episode seeds an evaluation uses.

use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Keeps these draws apart from other uses of a run's seed.
const PURPOSE: u64 = u64::from_be_bytes(*b"episodes");

/// The episode seeds of the evaluation at `step`: a function of the run's seed and the step alone, distinct within an
/// evaluation, and new ones at each step, so that no evaluation is tuned to one set of starting states. Runs with the
/// same seed that differ in guidance or candidates meet the same episodes. 53 bits, which JSON readers keep exactly.
pub fn episode_seeds(run_seed: u64, step: u64, episodes: u32) -> Vec<u64> {
    let mut generator = ChaCha8Rng::seed_from_u64(run_seed ^ PURPOSE);
    generator.set_stream(step);
    let mut seeds = Vec::with_capacity(episodes as usize);
    while seeds.len() < episodes as usize {
        let seed = generator.next_u64() >> 11;
        if !seeds.contains(&seed) {
            seeds.push(seed);
        }
    }
    seeds
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn seeds_are_repeatable_and_distinct_between_evaluations_and_runs() {
        assert_eq!(episode_seeds(3, 1000, 10), episode_seeds(3, 1000, 10));
        assert_eq!(episode_seeds(3, 1000, 10)[..4], episode_seeds(3, 1000, 4));
        let mut seen = HashSet::new();
        for (run, step) in [(3, 1000), (3, 2000), (4, 1000)] {
            assert!(episode_seeds(run, step, 50).into_iter().all(|seed| seed < 1 << 53 && seen.insert(seed)));
        }
    }
}
