//! What an evaluator does: runs policies in MuJoCo, and records datasets there.
//!
//! # Layout
//!
//! In reading order:
//!
//! - [`environment`]: the tasks, with the semantics that D4RL's scores are defined by.
//! - [`rollout`]: many episodes as one batch, one policy call per step.
//! - [`collect`]: trains behaviour from random to competent and records it as a dataset.
//! - [`verify`]: replays a recorded dataset and measures how far the simulation is from it.
//! - [`score`]: scores saved policies, on this machine alone.
//! - [`serve`]: finds runs on the network, evaluates their snapshots; [`metrics`]: its Prometheus metrics.
//! - [`doctor`]: checks this machine before it is trusted with any of that.
//! - [`cli`]: the command line.

pub mod cli;
pub mod collect;
pub mod doctor;
pub mod environment;
pub mod metrics;
pub mod rollout;
pub mod score;
pub mod serve;
pub mod verify;
