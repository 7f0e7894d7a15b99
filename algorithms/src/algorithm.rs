//! The interface between an algorithm and the learner.

use candle_core::Result;
use quad_nn::Tensors;
use quad_policy::PolicyConfig;

use super::state_dict::StateDict;

/// Metrics of an update by the names in the algorithm's table.
pub type Measured = Vec<(&'static str, f32)>;

/// The updates of an algorithm, its policy and its state.
pub trait Algorithm: Send {
    /// The number of examples that batches are drawn from: transitions, unless an algorithm leaves
    /// some out or learns from windows of them.
    fn dataset_len(&self, transitions: usize) -> usize {
        transitions
    }

    /// The first step of each training phase; updates of different phases take different times.
    fn phases(&self) -> Vec<u64> {
        vec![0]
    }

    /// Performs update number `step`, from 0, on the examples with these indices. Its random
    /// numbers are a function of the run's seed and `step`.
    fn update(&mut self, step: u64, indices: &[u32]) -> Result<Measured>;

    /// Computes the losses of update number `step` and changes nothing.
    fn evaluate(&self, step: u64, indices: &[u32]) -> Result<Measured>;

    /// The policy to be evaluated: its description and its tensors.
    fn policy(&self) -> Result<(PolicyConfig, Tensors)>;

    /// Everything that updates change; with the step it determines the rest of the run.
    fn state_dict(&mut self) -> StateDict<'_>;
}
