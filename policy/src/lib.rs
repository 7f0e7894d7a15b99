//! What the weights mean: the diffusion policy and the critic ensemble, forward and backward.
//!
//! # Layout
//!
//! - [`Architecture`] (`architecture`): the shapes; [`Parameters`] (`parameters`): weights and their names in files.
//! - [`Schedule`] (`schedule`): the variance-preserving noise schedule and one reverse step.
//! - [`NoisePredictor`] (`noise_predictor`): ε_θ, its gradient, the sampler.
//! - [`CriticEnsemble`] (`ensemble`): values, regression, gradients at actions.
//! - [`TargetPolicy`] (`select`): acting by the best of N_a candidates.
//! - [`Precision`] (`precision`): how exactly networks are evaluated that no gradient is taken of.
//! - below them `network` (the MLP that actor and critics share), `mlp` (where its layers lie), `elementwise` (Mish and
//!   what is fused with it) and `matmul` (with `avx512`).
//! - [`reference`]: the same networks as plain candle tensors, to read, to differentiate and to test against.
//!
//! Buffers are row-major `f32` slices; a name's shape is given as `rows × columns`. Everything that draws random
//! numbers takes them as an argument or from a seeded generator.

mod architecture;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod buffer;
mod elementwise;
mod ensemble;
mod error;
mod matmul;
mod mlp;
mod network;
mod noise_predictor;
mod parameters;
mod precision;
pub mod reference;
mod schedule;
mod select;

pub use architecture::Architecture;
pub use elementwise::{mish_in_place, mish_slope};
pub use ensemble::{CriticEnsemble, RoundedCritics, StateActions};
pub use error::PolicyError;
pub use noise_predictor::{NoisePredictor, NoisyActions, Recording, RoundedActor};
pub use parameters::Parameters;
pub use precision::Precision;
pub use schedule::Schedule;
pub use select::{ActionNoise, Selection, TargetPolicy};
