//! Policies: observations in, actions out, and the file that holds one.
//!
//! # Layout
//!
//! - [`Policy`] (`policy`) acts; [`EpisodeState`] is its state in an episode. `scaled` converts from
//!   and to the user's units, given a [`Scaling`]; `chunk` executes policies of several steps at a
//!   time.
//! - `file`: [`load_policy`] reads a policy from a file with a [`Header`].
//! - `kinds/`: [`GaussianPolicy`]; [`DiffusionPolicy`], [`ScorePolicy`], and those of an
//!   [`ActorCriticShape`] with a [`SquashedActor`], a [`OneStepActor`] or a [`FlowActor`], which draw
//!   candidates; [`DiffuserPolicy`], which draws plans with a [`Planner`].
//! - `sampling/`: candidates, and the [`Choice`] among them.

#![deny(unsafe_code)]

mod chunk;
mod error;
mod file;
mod kinds;
mod policy;
mod sampling;
mod scaled;
#[cfg(test)]
mod testing;

pub use chunk::Chunk;
pub use error::PolicyError;
pub use file::{Header, PolicyConfig, load_policy, read_header, read_tensors, write_tensors};
pub use kinds::actor_critic::ActorCriticShape;
pub use kinds::diffuser::DiffuserPolicy;
pub use kinds::diffusion::{DiffusionPolicy, DiffusionShape};
pub use kinds::flow::{FlowActor, flow_velocity};
pub use kinds::gaussian::{GaussianPolicy, GaussianShape, Spread, gaussian_mean};
pub use kinds::one_step::OneStepActor;
pub use kinds::planner::{DiffuserShape, Planner, ValueGuidance, with_first_state};
pub use kinds::score::{ScorePolicy, ScorePolicyShape};
pub use kinds::squashed::SquashedActor;
pub use policy::{Policy, Samples};
pub use quad_nn::{Activation, Affine, MlpConfig, NetworkError, Precision, Scaling};
pub use sampling::choice::{Aggregate, Choice, Rule};
pub use sampling::episode::EpisodeState;
