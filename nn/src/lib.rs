//! Networks in candle and their training. Knows nothing of policies.
//!
//! # Layout
//!
//! - [`Weights`]: a network's weights, named tensors in one vector; `gradients/`: the [`Gradients`]
//!   of a loss with respect to them; [`Adam`] applies these.
//! - `layers/`: K fully connected networks as one operation, configured by [`MlpConfig`].
//! - [`Ensemble`]: such networks as critics, value functions or means, of an [`EnsembleShape`].
//! - `diffusion/`: [`Schedule`], [`NoisePredictor`] ε_θ, and the EDM [`Denoiser`].
//! - `score/`: SfBC's [`ScoreNetwork`], sampled by [`DpmSolver`].
//! - `trajectory/`: Diffuser's [`TrajectoryModel`] and [`TrajectoryValue`].
//! - `gpu/`: opening a GPU, and capturing its work as a [`CudaGraph`].
//! - `statistics`: statistics and losses.
//! - `slices`, `pool`: tensors as slices and reused memory, for the fast implementations on the CPU.
//!
//! Random numbers are arguments or come from a seeded generator.

#![deny(unsafe_code)]

mod adam;
mod diffusion;
mod ensemble;
mod error;
mod gpu;
mod gradients;
#[cfg(test)]
mod implementations;
mod layers;
mod pool;
mod score;
mod shape;
mod slices;
mod statistics;
#[cfg(test)]
mod testing;
mod trajectory;
mod weighted;
mod weights;

pub use adam::{Adam, AdamStep, cosine_decay};
pub use diffusion::denoised::Denoised;
pub use diffusion::edm::{Denoiser, DenoiserShape, NoiseLevels};
pub use diffusion::noise_predictor::NoisePredictor;
pub use diffusion::schedule::{Reverse, Schedule};
pub use ensemble::Ensemble;
pub use error::{MAX_DIM, NetworkError};
pub use gpu::cuda_graph::{CudaGraph, overwrite};
#[cfg(feature = "cuda")]
pub use gpu::numbers::guide;
pub use gpu::open_gpu;
pub use gradients::gradient::Gradients;
pub use layers::config::{InitScheme, MlpConfig, NormEpsilon};
pub use quad_kernels::Precision;
pub use quad_kernels::activation::Activation;
pub use quad_kernels::scaling::{Affine, Scaling};
pub use score::dpm_solver::{ContinuousNoise, DpmSolver};
pub use score::network::{ScoreNetwork, ScoreShape};
pub use shape::{EnsembleShape, NoiseShape, f32_bytes, tile_floats};
pub use slices::read;
pub use statistics::{mean_and_variance, pulled_error, squared_error};
pub use trajectory::config::{Attention, TrajectoryConfig, TrajectoryError};
pub use trajectory::networks::{TrajectoryModel, TrajectoryValue};
pub use weighted::Weighted;
pub use weights::{Init, Layout, TensorSpec, Tensors, Weights, check_finite, take};
