//! Seeds of evaluation and online episodes.

use std::collections::HashSet;
use std::iter;

use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Separate these draws from other uses of a run's seed. Recorded runs depend on the bytes.
const EVALUATION: u64 = u64::from_be_bytes(*b"episodes");
const ONLINE: u64 = u64::from_be_bytes(*b"practice");

/// The episode seeds of the evaluation at `step`: distinct, and different at each step, so that no
/// evaluation is tuned to one set of starting states. Runs with the same seed that differ in
/// hyper-parameters have the same episodes. Seeds have 53 bits, which JSON readers keep exactly.
pub fn episode_seeds(run_seed: u64, step: u64, episodes: u32) -> Vec<u64> {
    let mut generator = ChaCha8Rng::seed_from_u64(run_seed ^ EVALUATION);
    generator.set_stream(step);
    let mut seen = HashSet::new();
    let new = |seed: &u64| seen.insert(*seed);
    iter::repeat_with(|| generator.next_u64() >> 11).filter(new).take(episodes as usize).collect()
}

/// The seed of a run's online episode, counted from 0. It equals another given seed of the run with
/// a probability of 2⁻⁵³.
pub fn online_seed(run_seed: u64, episode: u64) -> u64 {
    let mut generator = ChaCha8Rng::seed_from_u64(run_seed ^ ONLINE);
    generator.set_stream(episode);
    generator.next_u64() >> 11
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seeds_are_repeatable_and_distinct_between_evaluations_and_runs() {
        assert_eq!(episode_seeds(3, 1000, 10)[..4], episode_seeds(3, 1000, 4));
        let mut seen = HashSet::new();
        for (run, step) in [(3, 1000), (3, 2000), (4, 1000)] {
            let mut seeds = episode_seeds(run, step, 50).into_iter();
            assert!(seeds.all(|seed| seed < 1 << 53 && seen.insert(seed)));
        }
        for (run, episode) in [3, 4].into_iter().flat_map(|run| (0..50).map(move |j| (run, j))) {
            let seed = online_seed(run, episode);
            assert!(seed < 1 << 53 && seen.insert(seed) && seed == online_seed(run, episode));
        }
    }
}
