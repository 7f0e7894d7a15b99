//! The gradients of a loss with respect to weights.

use crate::gradients::kept::backward_pass;
use crate::weights::Weights;
use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, bail};

/// The gradients of one loss, from [`Gradients::of`].
pub struct Gradients {
    pub(crate) store: GradStore,
    pass: u64,
}

impl Gradients {
    /// A backward pass through everything that a loss `[]` depends on.
    pub fn of(loss: &Tensor) -> Result<Self> {
        let (store, pass) = backward_pass(|| loss.backward());
        Ok(Self { store: store?, pass })
    }

    /// Gradient of all weights of a network, in the order of its vector. The next backward pass to
    /// these weights overwrites it.
    ///
    /// # Errors
    /// The loss does not depend on them, or another backward pass has come in between.
    pub fn with_respect_to(&self, weights: &Weights) -> Result<Tensor> {
        let kept = weights.kept_gradient().and_then(|kept| kept.read(self.pass));
        // A loss may reach the weights through fast implementations, plain ones, or both.
        match (kept, self.store.get(weights.values())) {
            (Some(kept), Some(returned)) => kept + returned,
            (Some(gradient), None) => Ok(gradient),
            (None, Some(gradient)) => Ok(gradient.clone()),
            (None, None) => bail!("the loss does not depend on the weights that it is to train"),
        }
    }
}
