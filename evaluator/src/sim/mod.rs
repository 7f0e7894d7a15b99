//! Simulation: environments, and batches of episodes.
//!
//! Owns the compiled MuJoCo models, which the process shares. Everything runs on the calling
//! thread; a rollout shares the physics among rayon's threads.
//!
//! # Layout
//!
//! - `environment`: the traits of an environment; `simulation`: an environment that this program
//!   simulates; `physics`: drives MuJoCo for it.
//! - `planar` (Hopper, HalfCheetah, Walker2d), `maze`: the tasks, with the rules that D4RL's scores
//!   are defined by.
//! - `simulations`: makes an environment by its row in the dataset crate's table.
//! - `rollout`: many episodes as one batch, one policy call for each step.

mod environment;
mod maze;
mod physics;
mod planar;
mod rollout;
mod simulation;
mod simulations;

pub use environment::{Environment, EnvironmentError, Environments, Step};
pub use rollout::{Rollout, Stepped};
pub use simulation::Simulation;
pub use simulations::{Simulations, make, mjcf};
