//! Policies: observations in, actions out, and the file that holds one.
//!
//! # Layout
//!
//! - [`Policy`] (`policy`) acts; [`EpisodeState`] is its state in an episode. `executor` acts in
//!   the user's units, given a [`Scaling`], and executes a [`Chunk`] of several steps at a time.
//! - `file`: [`load_policy`] reads a policy from a file with a [`Header`].
//! - `kinds/`: [`GaussianPolicy`]; [`DiffusionPolicy`], [`ScorePolicy`], and those of an
//!   [`ActorCriticShape`] with a [`SquashedActor`], a [`OneStepActor`] or a [`FlowActor`], which draw
//!   candidates; [`DiffuserPolicy`], which draws plans.
//! - `sampling/`: candidates, and the [`Choice`] among them.

#![deny(unsafe_code)]

mod error;
mod executor;
mod file;
mod kinds;
mod policy;
mod sampling;
#[cfg(test)]
mod testing;

pub use error::PolicyError;
pub use executor::Chunk;
pub use file::{Header, PolicyConfig, load_policy, read_header, read_tensors, write_tensors};
pub use kinds::actor_critic::ActorCriticShape;
pub use kinds::diffuser::{DiffuserPolicy, DiffuserShape, ValueGuidance, with_first_state};
pub use kinds::diffusion::{DiffusionPolicy, DiffusionShape};
pub use kinds::flow::{FlowActor, OneStepActor, flow_velocity};
pub use kinds::gaussian::{GaussianPolicy, GaussianShape, Spread, gaussian_mean};
pub use kinds::score::{ScorePolicy, ScorePolicyShape};
pub use kinds::squashed::SquashedActor;
pub use policy::{Policy, Samples};
pub use quad_nn::{Activation, Affine, MlpConfig, NetworkError, Precision, Scaling};
pub use sampling::choice::{Aggregate, Choice, Rule};
pub use sampling::episode::EpisodeState;
