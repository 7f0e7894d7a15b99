//! The gradients of a loss.

use crate::gradients::buffer::backward_pass;
use crate::weights::Weights;
use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, bail};

/// The gradients of one loss.
pub struct Gradients {
    pub(crate) store: GradStore,
    pass: u64,
}

impl Gradients {
    /// Runs the backward pass of a loss `[]`.
    pub fn backward(loss: &Tensor) -> Result<Self> {
        let (store, pass) = backward_pass(|| loss.backward());
        let store = store?;
        Ok(Self { store, pass })
    }

    /// Gradient of a network's weights, `[P]`. The next backward pass to these weights overwrites
    /// it.
    ///
    /// # Errors
    /// The loss does not depend on these weights, or another backward pass has overwritten them.
    pub fn with_respect_to(&self, weights: &Weights) -> Result<Tensor> {
        let buffered = weights.gradient_buffer().and_then(|buffer| buffer.read(self.pass));
        // A loss can reach the weights through fast implementations, plain ones, or both.
        match (buffered, self.store.get(weights.values())) {
            (Some(buffered), Some(returned)) => buffered + returned,
            (Some(gradient), None) => Ok(gradient),
            (None, Some(gradient)) => Ok(gradient.clone()),
            (None, None) => bail!("the loss does not depend on the weights that it is to train"),
        }
    }
}
