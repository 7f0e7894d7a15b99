//! The evaluator: runs policies in MuJoCo, and records datasets there.
//!
//! # Layout
//!
//! - [`sim`]: environments, and batches of episodes. The next two use it, and not each other:
//! - [`serve`]: finds runs on the network, evaluates their snapshots, delivers the scores.
//! - `tools`: records and replays datasets, scores and films policies, on this machine.
//! - [`cli`]: the command line; `doctor`: checks of this machine; `metrics`: for Prometheus.
#![allow(missing_docs)] // A program: a name that says enough needs no comment.

pub mod cli;
mod doctor;
mod metrics;
pub mod serve;
pub mod sim;
mod tools;
