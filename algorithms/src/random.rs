//! Random numbers: a stream per purpose, each a function of the run's seed and a counter, so that a
//! checkpoint needs no generator's state.

use candle_core::{Device, Result, Shape, Tensor, WithDType};
#[cfg(test)]
use quad_nn::Tensors;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use std::ops::Range;

#[derive(Clone, Copy)]
#[repr(u64)]
pub(super) enum Purpose {
    /// Initial weights; counted by network.
    Weights = u64::from_be_bytes(*b"weights "),
    /// Noise of an update; counted by gradient step.
    Noise = u64::from_be_bytes(*b"noise   "),
    /// Actions of a clone in the data's states; counted by transition.
    Actions = u64::from_be_bytes(*b"actions "),
}

/// The random stream of a run's seed for a purpose.
pub(super) fn stream(seed: u64, purpose: Purpose, count: u64) -> ChaCha8Rng {
    let mut generator = ChaCha8Rng::seed_from_u64(seed ^ purpose as u64);
    generator.set_stream(count);
    generator
}

/// Draws tensors of random numbers. In a golden test the tensor of a name is the folder's.
pub(super) struct Random {
    pub generator: ChaCha8Rng,
    pub device: Device,
    #[cfg(test)]
    pub golden: Option<std::sync::Arc<Tensors>>,
}

impl Random {
    /// Standard normal numbers.
    pub fn normal(&mut self, name: &str, shape: impl Into<Shape>) -> Result<Tensor> {
        self.tensor(name, shape, |generator| -> f32 { StandardNormal.sample(generator) })
    }

    /// Numbers that are uniform in a range.
    pub fn uniform(
        &mut self,
        name: &str,
        shape: impl Into<Shape>,
        range: Range<f32>,
    ) -> Result<Tensor> {
        self.tensor(name, shape, |generator| generator.random_range(range.clone()))
    }

    /// Numbers from one draw each.
    pub fn tensor<T: WithDType>(
        &mut self,
        name: &str,
        shape: impl Into<Shape>,
        mut draw: impl FnMut(&mut ChaCha8Rng) -> T,
    ) -> Result<Tensor> {
        let shape = shape.into();
        let numbers = self.vector(name, |generator| {
            Ok((0..shape.elem_count()).map(|_| draw(generator)).collect())
        })?;
        Tensor::from_vec(numbers, shape, &self.device)
    }

    /// Numbers on the CPU.
    #[cfg_attr(not(test), allow(unused_variables))]
    pub fn vector<T: WithDType>(
        &mut self,
        name: &str,
        draw: impl FnOnce(&mut ChaCha8Rng) -> Result<Vec<T>>,
    ) -> Result<Vec<T>> {
        #[cfg(test)]
        if let Some(golden) = &self.golden {
            return golden[name].to_dtype(T::DTYPE)?.flatten_all()?.to_vec1();
        }
        draw(&mut self.generator)
    }
}
