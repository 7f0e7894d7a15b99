//! What an evaluator does: runs policies in MuJoCo, and records datasets there.
//!
//! # Layout
//!
//! In reading order:
//!
//! - [`environment`]: the tasks, with the semantics that D4RL's scores are defined by.
//! - [`rollout`]: many episodes as one batch, one policy call per step.
//! - [`cli`]: the command line.

pub mod cli;
pub mod environment;
pub mod rollout;
