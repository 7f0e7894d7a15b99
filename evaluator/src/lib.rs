//! What an evaluator does: runs policies in MuJoCo, and records datasets there.
//!
//! # Layout
//!
//! Three rooms, of which the later two use the first and never each other:
//!
//! - [`sim`]: the tasks and whole batches of their episodes.
//! - [`serve`]: finds runs on the network, evaluates their snapshots, delivers the scores.
//! - [`tools`]: records datasets, replays them, scores saved policies, on this machine alone.
//!
//! Beside them: [`cli`], the command line; `doctor`, which checks this machine before it evaluates anything; `metrics`, what
//! Prometheus is told.

pub mod cli;
mod doctor;
mod metrics;
pub mod serve;
pub mod sim;
pub mod tools;
