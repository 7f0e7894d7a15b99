//! Networks in candle and how they are trained. Knows nothing of policies.
//!
//! # Layout
//!
//! - `layers/`: K fully connected networks act(x·W + b) as one operation with gradients to x, W and
//!   b ([`MlpConfig`] is their line of configuration). `mlp` has a fast implementation for the CPU
//!   (`network`, tile by tile over the crate `kernels`), `composed` one of few operations for a
//!   GPU, `plain` one of candle's own operations, which also has layer norm.
//! - [`Ensemble`]: such networks as critics, value functions or means; their shapes are in `shape`.
//! - `diffusion/`: [`Schedule`], [`NoisePredictor`] ε_θ, and the EDM [`Denoiser`], conditioned on σ.
//! - `score/`: SfBC's [`ScoreNetwork`] of residual blocks, sampled by [`DpmSolver`].
//! - `trajectory/`: Diffuser's [`TrajectoryModel`] and [`TrajectoryValue`] over windows of consecutive steps.
//! - [`Weights`]: a network's weights as one vector with named tensors in it; [`Gradients`] of a
//!   loss with respect to them; [`Adam`].
//! - `gpu/`: opening a GPU, and recording its work as a CUDA graph ([`CudaGraph`]).
//!
//! Everything that draws random numbers takes them as an argument or from a seeded generator.

#![deny(unsafe_code)]

mod adam;
mod diffusion;
mod ensemble;
mod error;
mod gpu;
mod gradients;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod implementations;
mod layers;
mod precision;
mod score;
mod shape;
mod slices;
mod statistics;
mod trajectory;
mod weighted;
mod weights;

pub use adam::{Adam, AdamStep, cosine_decay};
pub use diffusion::edm::{Denoiser, DenoiserShape, NoiseLevels};
pub use diffusion::noise_predictor::NoisePredictor;
pub use diffusion::schedule::{Reverse, Schedule};
pub use ensemble::Ensemble;
pub use error::{MAX_DIM, NetworkError};
pub use gpu::cuda_graph::{CudaGraph, overwrite};
pub use gpu::device::open_gpu;
pub use gradients::gradient::Gradients;
pub use layers::config::{Epsilon, Initial, MlpConfig};
pub use precision::Precision;
pub use quad_kernels::activation::Activation;
pub use quad_kernels::scaling::{Affine, Scaling};
pub use score::dpm_solver::{ContinuousNoise, DpmSolver};
pub use score::network::{ScoreNetwork, ScoreShape};
pub use shape::{EnsembleShape, NoiseShape, bytes, tile_numbers};
pub use slices::read;
pub use statistics::mean_and_variance;
pub use trajectory::config::{Attention, TrajectoryConfig, TrajectoryError};
pub use trajectory::networks::{TrajectoryModel, TrajectoryValue};
pub use weighted::Weighted;
pub use weights::{Init, Layout, TensorSpec, Tensors, Weights, check_finite, take};
