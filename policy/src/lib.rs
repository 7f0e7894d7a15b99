//! What the weights mean: networks, the diffusion they predict the noise of, and the policies made
//! of them.
//!
//! # Layout
//!
//! - [`MlpConfig`] (`mlp_config`): a network's hidden layers, a line of configuration; `shape`:
//!   what goes in and comes out.
//! - `mlp`: K networks of layers act(x·W + b) as one operation of candle's, with gradients to x, W
//!   and b. It has a fast implementation for the CPU, one of few operations for a GPU (`composed`),
//!   and a plain one (`plain`) that runs on any device and has layer norm.
//! - [`Ensemble`] (`ensemble`): such networks as critics, value functions or means;
//!   [`NoisePredictor`] (`noise_predictor`): ε_θ; [`Denoiser`] (`edm`), told of noise by a real
//!   number; [`Schedule`] (`schedule`): the noise schedule and one reverse step. `sampler` and
//!   `action_gradients` go through whole networks tile by tile.
//! - [`ScoreNetwork`] (`score_network`): residual blocks of single layers (`dense`), the noise in
//!   continuous time, sampled by [`DpmSolver`] (`dpm_solver`).
//! - [`Weights`] (`weights`): a network's weights as one vector with named tensors in it;
//!   [`Gradients`] (`gradient`) of a loss with respect to them; [`Adam`] (`optimizer`).
//! - [`Policy`] (`policy`): what any policy can do; [`EpisodeState`] (`episode`): what it carries
//!   through an episode. `kind` reads one from a file whose [`Header`] says what it is:
//!   [`DiffusionPolicy`] (`diffusion`), [`ScorePolicy`] (`score`), and with a [`SquashedActor`]
//!   (`squashed`) or a [`OneStepActor`] (`one_step`) those of an [`ActorCriticShape`]
//!   (`actor_critic`) take one of N_a samples (`candidates`), or the mean of some, by their
//!   [`Choice`] (`choice`), [`GaussianPolicy`] (`gaussian`) a mean; one with a [`Scaling`] is asked
//!   in its user's units (`scaled`).
//! - [`WindowModel`] and [`WindowValue`] (`window_networks`): networks over windows of consecutive
//!   steps, of the layers in `window_layers`, `convolution` and `group_norm`; `window` lists their
//!   tensors. [`Planner`] (`planner`) acts by plans that `planning` draws with them.
//! - [`Precision`] (`precision`): how exactly networks are evaluated that no gradient is taken of.
//! - Below: `layers` (where each layer lies in the vector), `network` (one network on one tile of
//!   rows, over the crate `kernels`, with the buffers of `workspace`), `saved` and `kept_gradient`
//!   (what forward and backward passes leave), `operation` (candle's custom operations), `packed`
//!   (kernels packed once), `slices` (candle's tensors as slices), `gpu` (the same on a GPU),
//!   `device` (a GPU to compute on), [`Recording`] (`recording`: its work, recorded), `statistics`
//!   (mean and variance over an ensemble).
//!
//! Everything that draws random numbers takes them as an argument or from a seeded generator.

#![deny(unsafe_code)]

mod action_gradients;
mod actor_critic;
mod candidates;
mod choice;
mod composed;
mod convolution;
mod dense;
mod dense_graph;
mod device;
mod differentiable;
mod diffusion;
mod dpm_solver;
mod edm;
mod ensemble;
mod episode;
mod error;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod finite_differences;
mod gaussian;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;
#[cfg(feature = "cuda")]
mod gpu;
mod gradient;
mod group_norm;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod implementations;
mod kept_gradient;
mod kind;
mod layers;
mod mlp;
mod mlp_config;
mod network;
mod noise_predictor;
mod one_step;
mod operation;
mod optimizer;
mod packed;
mod plain;
mod planner;
mod planning;
mod policy;
mod precision;
mod recording;
mod sampler;
mod saved;
mod scaled;
mod schedule;
mod score;
mod score_network;
mod shape;
mod slices;
mod squashed;
mod statistics;
mod weighted;
mod weights;
mod window;
mod window_layers;
mod window_networks;
mod workspace;

pub use actor_critic::ActorCriticShape;
pub use choice::{Choice, Reduce, Rule};
pub use device::open_gpu;
pub use diffusion::{DiffusionPolicy, DiffusionShape};
pub use dpm_solver::{ContinuousNoise, DpmSolver};
pub use edm::{Denoiser, DenoiserShape, NoiseLevels};
pub use ensemble::Ensemble;
pub use episode::EpisodeState;
pub use error::PolicyError;
pub use gaussian::{GaussianPolicy, GaussianShape, gaussian_mean};
pub use gradient::Gradients;
pub use kind::{Header, PolicyConfig, load_policy, read_header, read_tensors, write_tensors};
pub use mlp_config::{Epsilon, Initial, MlpConfig};
pub use noise_predictor::NoisePredictor;
pub use one_step::OneStepActor;
pub use optimizer::{Adam, AdamStep, cosine_decay};
pub use planner::{Guidance, Planner, PlannerShape};
pub use planning::{Planning, with_first_state};
pub use policy::{Policy, Sampled};
pub use precision::Precision;
pub use quad_kernels::activation::Activation;
pub use quad_kernels::scaling::{Affine, Scaling};
pub use recording::{Recording, overwrite};
pub use schedule::{Reverse, Schedule};
pub use score::{ScorePolicy, ScorePolicyShape};
pub use score_network::{ScoreNetwork, ScoreShape};
pub use shape::{EnsembleShape, NoiseShape};
pub use squashed::SquashedActor;
pub use statistics::mean_and_variance;
pub use weighted::Weighted;
pub use weights::{Layout, Part, Start, Tensors, Weights, take};
pub use window::{Attention, WindowConfig, WindowError};
pub use window_networks::{WindowModel, WindowValue};
