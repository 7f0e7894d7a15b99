//! Gradients of a loss with respect to a network's weights.

pub(crate) mod buffer;
pub(crate) mod differentiable;
pub(crate) mod gradient;
