//! The interface between an algorithm and the learner.

use super::batch::Batch;
use super::losses::Measured;
use super::state_dict::StateDict;
use quad_nn::Tensors;
use quad_policy::PolicyConfig;

/// The updates of an algorithm, its policy and its state.
pub trait Algorithm: Send {
    /// The first step of each training phase; updates of different phases take different times.
    fn phases(&self) -> Vec<u64> {
        vec![0]
    }

    /// True if an update takes batches from the CPU on any device: it copies them with its noise.
    fn copies_batches(&self) -> bool {
        false
    }

    /// Performs update number `step`, from 0. Its random numbers are a function of the run's seed and
    /// `step`.
    fn update(&mut self, step: u64, batch: &Batch) -> candle_core::Result<Measured>;

    /// Computes the losses of update number `step` and changes nothing.
    fn evaluate(&self, step: u64, batch: &Batch) -> candle_core::Result<Measured>;

    /// The policy to be evaluated: its description and its tensors.
    fn policy(&self) -> candle_core::Result<(PolicyConfig, Tensors)>;

    /// Everything that updates change; with the step it determines the rest of the run.
    fn state_dict(&mut self) -> StateDict<'_>;
}
