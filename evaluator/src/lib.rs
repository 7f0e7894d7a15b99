//! The evaluator: runs policies in MuJoCo, and records datasets there.
//!
//! # Layout
//!
//! Three modules. The second and third use the first, and not each other:
//!
//! - [`sim`]: environments, and batches of episodes.
//! - [`serve`]: finds runs on the network, evaluates their snapshots, delivers the scores.
//! - [`tools`]: records and replays datasets, scores and films saved policies, on this machine
//!   alone.
//!
//! Also: [`cli`], the command line; `doctor`, checks of this machine; `metrics`, for Prometheus.

pub mod cli;
mod doctor;
mod metrics;
pub mod serve;
pub mod sim;
pub mod tools;
