//! Sampling of mini-batches without replacement.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Distinguishes this random stream from others of the run's seed.
const PURPOSE: u64 = u64::from_be_bytes(*b"batches ");

/// Shuffled epochs, in an order that depends on seed and epoch only. Batches may span two epochs.
pub struct BatchSampler {
    seed: u64,
    pass: u64,
    /// Permutation, of which the first `position` indices are drawn.
    order: Vec<u32>,
    position: usize,
    indices: Vec<u32>,
    generator: ChaCha8Rng,
}

impl BatchSampler {
    /// Sampler of `batch_size` out of `len` transitions after `batches` batches.
    ///
    /// # Panics
    /// If `len` is 0.
    pub fn new(len: usize, batch_size: usize, seed: u64, batches: u64) -> Self {
        assert!(len > 0, "there is nothing to sample from");
        let drawn = u128::from(batches) * batch_size as u128;
        let mut sampler = Self {
            seed,
            pass: (drawn / len as u128) as u64,
            order: (0..len as u32).collect(),
            position: 0,
            indices: vec![0; batch_size],
            generator: ChaCha8Rng::seed_from_u64(seed ^ PURPOSE),
        };
        sampler.start_pass();
        for _ in 0..drawn % len as u128 {
            sampler.draw();
        }
        sampler
    }

    /// Indices of the next batch.
    pub fn next_items(&mut self) -> &[u32] {
        for i in 0..self.indices.len() {
            self.indices[i] = self.draw();
        }
        &self.indices
    }

    fn start_pass(&mut self) {
        self.generator = ChaCha8Rng::seed_from_u64(self.seed ^ PURPOSE);
        self.generator.set_stream(self.pass);
        self.order.iter_mut().zip(0..).for_each(|(place, i)| *place = i);
        self.position = 0;
    }

    /// One step of a Fisher–Yates shuffle, which spreads its cost over the epoch.
    fn draw(&mut self) -> u32 {
        if self.position == self.order.len() {
            self.pass += 1;
            self.start_pass();
        }
        let chosen = self.generator.random_range(self.position..self.order.len());
        self.order.swap(self.position, chosen);
        self.position += 1;
        self.order[self.position - 1]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passes(len: usize, seed: u64, draws: usize) -> Vec<u32> {
        let mut sampler = BatchSampler::new(len, 1, seed, 0);
        (0..draws).map(|_| sampler.draw()).collect()
    }

    #[test]
    fn every_pass_draws_everything_once_in_another_order() {
        let draws = passes(100, 3, 300);
        let mut seen = Vec::new();
        for pass in draws.chunks(100) {
            let mut sorted = pass.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..100).collect::<Vec<_>>());
            assert_ne!(sorted, pass);
            assert!(!seen.contains(&pass));
            seen.push(pass);
        }
    }

    #[test]
    fn a_sampler_goes_on_where_another_one_was() {
        let all = passes(50, 7, 240);
        assert_ne!(all, passes(50, 8, 240));
        for batches in [0, 1, 7, 10, 16, 20, 33] {
            let mut sampler = BatchSampler::new(50, 5, 7, batches);
            let rest: Vec<u32> = (0..25).map(|_| sampler.draw()).collect();
            assert_eq!(rest, all[5 * batches as usize..][..25], "after {batches} batches");
        }
    }

    #[test]
    fn all_first_draws_are_equally_likely() {
        let mut counts = [0; 10];
        (0..10_000).for_each(|seed| counts[passes(10, seed, 1)[0] as usize] += 1);
        // Binomial(10000, 0.1): standard deviation 30.
        assert!(counts.iter().all(|count| (850..1150).contains(count)), "{counts:?}");
    }
}
