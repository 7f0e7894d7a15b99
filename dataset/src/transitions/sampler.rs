//! Sampling of mini-batches: of a dataset without replacement, of a dataset and experience with it.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Distinguish these random streams from others of the run's seed.
const PURPOSE: u64 = u64::from_be_bytes(*b"batches ");
const ONLINE: u64 = u64::from_be_bytes(*b"online  ");

/// Shuffled epochs, in an order that depends on seed and epoch only. Batches may span two epochs.
pub struct BatchSampler {
    seed: u64,
    epoch: u64,
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
            epoch: (drawn / len as u128) as u64,
            order: (0..len as u32).collect(),
            position: 0,
            indices: vec![0; batch_size],
            generator: ChaCha8Rng::seed_from_u64(seed ^ PURPOSE),
        };
        sampler.start_epoch();
        for _ in 0..drawn % len as u128 {
            sampler.draw();
        }
        sampler
    }

    /// Indices of the next batch.
    pub fn next_indices(&mut self) -> &[u32] {
        for i in 0..self.indices.len() {
            self.indices[i] = self.draw();
        }
        &self.indices
    }

    fn start_epoch(&mut self) {
        self.generator = ChaCha8Rng::seed_from_u64(self.seed ^ PURPOSE);
        self.generator.set_stream(self.epoch);
        self.order.iter_mut().zip(0..).for_each(|(place, i)| *place = i);
        self.position = 0;
    }

    /// One step of a Fisher–Yates shuffle, which spreads its cost over the epoch.
    fn draw(&mut self) -> u32 {
        if self.position == self.order.len() {
            self.epoch += 1;
            self.start_epoch();
        }
        let chosen = self.generator.random_range(self.position..self.order.len());
        self.order.swap(self.position, chosen);
        self.position += 1;
        self.order[self.position - 1]
    }
}

/// Batches of a dataset and experience, uniform with replacement.
pub struct OnlineSampler {
    seed: u64,
    share: Option<f64>,
    indices: Vec<u32>,
}

impl OnlineSampler {
    /// Sampler of `batch_size` transitions: with a `share`, round(share · batch size) of them are
    /// experience, after those of the dataset; without, all are of both together.
    pub fn new(batch_size: usize, share: Option<f64>, seed: u64) -> Self {
        Self { seed, share, indices: vec![0; batch_size] }
    }

    /// Indices of the batch of gradient step `step`, out of `len` transitions of the dataset and
    /// `experience` that follow them; without a dataset all are experience. Nothing but these and the arguments of [`new`](Self::new)
    /// decides.
    ///
    /// # Panics
    /// If `experience` is 0, but has a share.
    pub fn indices(&mut self, step: u64, len: usize, experience: usize) -> &[u32] {
        let mut generator = ChaCha8Rng::seed_from_u64(self.seed ^ ONLINE);
        generator.set_stream(step);
        let [len, all] = [len as u32, (len + experience) as u32];
        let size = self.indices.len();
        let share = self.share.filter(|_| len > 0);
        let shared = share.map(|share| size - (share * size as f64).round() as usize);
        for (i, index) in self.indices.iter_mut().enumerate() {
            *index = generator.random_range(match shared {
                None => 0..all,
                Some(first) if i < first => 0..len,
                Some(_) => len..all,
            });
        }
        &self.indices
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(len: usize, seed: u64, draws: usize) -> Vec<u32> {
        let mut sampler = BatchSampler::new(len, 1, seed, 0);
        (0..draws).map(|_| sampler.draw()).collect()
    }

    #[test]
    fn every_epoch_draws_everything_once_in_another_order() {
        let draws = drawn(100, 3, 300);
        let mut seen = Vec::new();
        for epoch in draws.chunks(100) {
            let mut sorted = epoch.to_vec();
            sorted.sort_unstable();
            assert_eq!(sorted, (0..100).collect::<Vec<_>>());
            assert_ne!(sorted, epoch);
            assert!(!seen.contains(&epoch));
            seen.push(epoch);
        }
    }

    #[test]
    fn a_sampler_goes_on_where_another_one_was() {
        let all = drawn(50, 7, 240);
        assert_ne!(all, drawn(50, 8, 240));
        for batches in [0, 1, 7, 10, 16, 20, 33] {
            let mut sampler = BatchSampler::new(50, 5, 7, batches);
            let rest: Vec<u32> = (0..25).map(|_| sampler.draw()).collect();
            assert_eq!(rest, all[5 * batches as usize..][..25], "after {batches} batches");
        }
    }

    #[test]
    fn all_first_draws_are_equally_likely() {
        let mut counts = [0; 10];
        (0..10_000).for_each(|seed| counts[drawn(10, seed, 1)[0] as usize] += 1);
        // Binomial(10000, 0.1): standard deviation 30.
        assert!(counts.iter().all(|count| (850..1150).contains(count)), "{counts:?}");
    }

    #[test]
    fn batches_online_depend_on_their_arguments_alone() {
        let batch = |seed, step, experience| {
            OnlineSampler::new(64, None, seed).indices(step, 1000, experience).to_vec()
        };
        let mut sampler = OnlineSampler::new(64, None, 3);
        let backward = [3, 2, 1].map(|step| sampler.indices(step, 1000, 50).to_vec());
        assert_eq!(backward, [3, 2, 1].map(|step| batch(3, step, 50)));
        let others = [batch(4, 2, 50), batch(3, 2, 51), batch(3, 1, 50)];
        assert!(!others.contains(&backward[1]));
    }

    #[test]
    fn batches_online_are_uniform_within_each_part() {
        for (share, expected) in [(Some(0.5), [12_800, 12_800]), (None, [19_200, 6_400])] {
            let mut counts = [0; 40];
            let mut sampler = OnlineSampler::new(256, share, 7);
            for step in 0..100 {
                for index in sampler.indices(step, 30, 10) {
                    counts[*index as usize] += 1;
                }
            }
            for (part, expected) in [&counts[..30], &counts[30..]].into_iter().zip(expected) {
                let (total, each) = (part.iter().sum::<i32>(), expected / part.len() as i32);
                assert!(share.is_none() || total == expected, "{share:?}: {total}");
                // Binomial: a standard deviation of at most 36.
                assert!(part.iter().all(|n| (n - each).abs() < 150), "{share:?}: {counts:?}");
            }
        }
        let all = OnlineSampler::new(256, Some(0.5), 7).indices(0, 0, 10).to_vec();
        assert!((0..10).all(|row| all.contains(&row)), "without a dataset: {all:?}");
        let batch = OnlineSampler::new(5, Some(0.3), 1).indices(0, 30, 10).to_vec();
        assert_eq!(batch.iter().filter(|index| **index >= 30).count(), 2, "0.3 · 5 is rounded");
    }
}
