//! Fully connected networks act(x·W + b), K of one shape side by side.

/// Hidden layers in a configuration.
pub(crate) mod config;
/// Offsets of the layers in the vector of weights.
pub(crate) mod flat;
/// The networks: dispatch between implementations, and candle's custom operation for the CPU.
pub(crate) mod mlp;
/// One network on one tile of rows.
pub(crate) mod network;
/// Kernels packed for products.
pub(crate) mod packed;
/// Candle's own operations.
pub(crate) mod plain;
/// Activations saved for the backward pass.
pub(crate) mod saved;
/// Buffers of a thread.
pub(crate) mod workspace;
