//! What the weights mean: networks, the diffusion they predict the noise of, and the policies made of them.
//!
//! # Layout
//!
//! - [`Ensemble`] (`ensemble`): K networks side by side, as critics, value functions or means; [`NoisePredictor`]
//!   (`noise_predictor`): ε_θ and the sampler; [`Schedule`] (`schedule`): the noise schedule and one reverse step.
//!   Each works on candle's tensors, and has two implementations: a custom operation for the CPU, and plain operations
//!   (`plain`) that run on any device.
//! - [`Weights`] (`weights`): a network's weights as one vector with named tensors in it, and their gradient.
//! - [`Policy`] (`policy`): what any policy can do, and what it carries through an episode. `kind` reads one from a file whose
//!   [`Header`] says what it is: [`DiffusionPolicy`] (`diffusion`, one of N_a samples by its [`Choice`], in `choice`) or
//!   [`GaussianPolicy`] (`gaussian`, a mean).
//! - [`Precision`] (`precision`): how exactly networks are evaluated that no gradient is taken of.
//! - Below: `ensemble_ops` and `noise_ops` (those custom operations, which `operation` gives to candle), `shape` and
//!   `layers` (where each layer lies in the vector), `network` (one network on one tile of rows, over the crate `kernels`),
//!   `saved` (what a forward pass keeps for the backward pass), `rounded` (kernels rounded once), `slices` (candle's tensors
//!   as slices), `statistics` (mean and variance over an ensemble).
//!
//! Everything that draws random numbers takes them as an argument or from a seeded generator.

#![deny(unsafe_code)]

mod choice;
mod diffusion;
mod ensemble;
mod ensemble_ops;
mod error;
mod gaussian;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;
mod gradient;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod implementations;
mod kind;
mod layers;
mod mlp;
mod network;
mod noise_predictor;
mod operation;
mod optimiser;
mod plain;
mod policy;
mod precision;
mod rounded;
mod sampler;
mod saved;
mod schedule;
mod shape;
mod slices;
mod statistics;
mod weights;

pub use choice::{Choice, Reduce, Rule};
pub use diffusion::{DiffusionPolicy, DiffusionShape};
pub use ensemble::Ensemble;
pub use error::PolicyError;
pub use gaussian::{GaussianPolicy, GaussianShape, gaussian_mean};
pub use gradient::Gradients;
pub use kind::{Header, PolicyConfig, load_policy, read_tensors};
pub use noise_predictor::NoisePredictor;
pub use optimiser::{Adam, AdamStep, cosine_decay};
pub use policy::{EpisodeState, Policy};
pub use precision::Precision;
pub use quad_kernels::activation::Activation;
pub use schedule::{Reverse, Schedule};
pub use shape::{EnsembleShape, Initial, MlpConfig, NoiseShape};
pub use statistics::mean_and_variance;
pub use weights::{Layout, Part, Start, Tensors, Weights, check_finite, take};
