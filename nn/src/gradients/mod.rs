//! Gradients of a loss with respect to a network's weights.

pub(crate) mod differentiable;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
pub(crate) mod finite_differences;
pub(crate) mod gradient;
pub(crate) mod kept;
