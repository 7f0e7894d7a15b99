//! Policies: kinds, sampling, the choice among candidates, and the file that holds one.
//!
//! # Layout
//!
//! - [`Policy`] (`policy`): observations in, actions out; [`EpisodeState`] is its state in an
//!   episode. A policy with a [`Scaling`] takes and gives its user's units (`scaled`).
//! - `file`: [`load_policy`] reads a policy from a file whose [`Header`] says what it is.
//! - `kinds/`: [`DiffusionPolicy`], [`ScorePolicy`], [`GaussianPolicy`], and those of an
//!   [`ActorCriticShape`], with a [`SquashedActor`] or a [`OneStepActor`]; Diffuser's [`DiffuserPolicy`]
//!   acts by plans.
//! - `sampling/`: N_a candidates per state, of which a [`Choice`] takes one, or the mean of some.

#![deny(unsafe_code)]

mod error;
mod file;
#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod golden;
mod kinds;
mod policy;
mod sampling;
mod scaled;

pub use error::PolicyError;
pub use file::{Header, PolicyConfig, load_policy, read_header, read_tensors, write_tensors};
pub use kinds::actor_critic::ActorCriticShape;
pub use kinds::diffuser::DiffuserPolicy;
pub use kinds::diffusion::{DiffusionPolicy, DiffusionShape};
pub use kinds::gaussian::{GaussianPolicy, GaussianShape, gaussian_mean};
pub use kinds::one_step::OneStepActor;
pub use kinds::planner::{DiffuserShape, Planner, ValueGuidance, with_first_state};
pub use kinds::score::{ScorePolicy, ScorePolicyShape};
pub use kinds::squashed::SquashedActor;
pub use policy::{Policy, Sampled};
pub use quad_nn::{Activation, Affine, MlpConfig, NetworkError, Precision, Scaling};
pub use sampling::choice::{Aggregate, Choice, Rule};
pub use sampling::episode::EpisodeState;
