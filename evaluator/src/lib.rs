//! What an evaluator does: runs policies in MuJoCo, and records datasets there.
//!
//! # Layout
//!
//! In reading order:
//!
//! - [`environment`]: the tasks, with the semantics that D4RL's scores are defined by.
//! - [`rollout`]: many episodes as one batch, one policy call per step.
//! - [`serve`]: finds runs on the network, measures the weights they publish; [`metrics`]: what it tells Prometheus.
//! - [`cli`]: the command line.

pub mod cli;
pub mod environment;
pub mod metrics;
pub mod rollout;
pub mod serve;
