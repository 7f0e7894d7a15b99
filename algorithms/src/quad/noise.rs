//! The random numbers of an update.

use super::config::{Config, Guidance};
use crate::diffusion::{Denoising, Sampler};
use crate::replay::Inputs;
use candle_core::{Device, Result, Tensor};
use rand::Rng;
use rand::seq::SliceRandom;

#[derive(Clone)]
pub(super) struct Noise {
    /// Noise of the sampled next actions, `[T, B·S, a]`.
    pub next: Tensor,
    /// t and ε of Eq. 5.
    pub denoising: Denoising,
    /// With guidance `shuffled`: the sample whose λ each sample takes, one of the same t, `[B]`.
    pub permutation: Option<Tensor>,
}

impl Inputs for Noise {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let mut tensors = self.denoising.tensors();
        tensors.push(&mut self.next);
        tensors.extend(&mut self.permutation);
        tensors
    }
}

impl Noise {
    pub fn draw(config: &Config, mut sampler: Sampler<'_>) -> Result<Self> {
        let next = sampler.chain("next_noise", *config.samples)?;
        let denoising = sampler.denoising()?;
        let permutation = match config.guidance {
            Guidance::Shuffled => {
                let t = denoising.t.to_vec1()?;
                let shuffled = |generator: &mut _| Ok(shuffled(&t, generator));
                let rows: Vec<u32> = sampler.random.vector("permutation", shuffled)?;
                Some(Tensor::new(rows, &Device::Cpu)?)
            }
            _ => None,
        };
        Ok(Self { next, denoising, permutation })
    }
}

/// A permutation of a batch that leaves each sample's t as it is.
fn shuffled(t: &[u32], generator: &mut impl Rng) -> Vec<u32> {
    let rows = || 0..t.len() as u32;
    let mut givers = Vec::from_iter(rows());
    givers.shuffle(generator);
    // Both in the order of t: the n-th sample of a t takes from the n-th of the shuffled ones.
    let mut takers = Vec::from_iter(rows());
    takers.sort_by_key(|row| t[*row as usize]);
    givers.sort_by_key(|row| t[*row as usize]);
    let mut permutation = vec![0; t.len()];
    for (taker, giver) in takers.into_iter().zip(givers) {
        permutation[taker as usize] = giver;
    }
    permutation
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_shuffle_permutes_the_samples_of_each_denoising_step() {
        let t = Vec::from_iter((0..500).map(|row| row % 3 + 1));
        let mut rows = shuffled(&t, &mut ChaCha8Rng::seed_from_u64(0));
        let keeps_step = |(row, step): (&u32, &u32)| t[*row as usize] == *step;
        assert!(rows.iter().zip(&t).all(keeps_step));
        // Of n things in random order one stays on average; of three t's three do.
        let stay = rows.iter().zip(0..).filter(|(row, place)| *row == place);
        assert!(stay.count() < 20);
        rows.sort_unstable();
        assert_eq!(rows, Vec::from_iter(0..500));
    }
}
