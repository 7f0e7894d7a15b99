//! The learner: trains on a dataset, publishes snapshots, collects their scores, and keeps
//! everything in the run's folder.
//!
//! # Layout
//! In reading order; each module may use those below it:
//!
//! - `cli` is the command line; [`command`] runs a command, up to its exit code.
//! - `sweep` runs many runs, each as a process.
//! - `live` is a run at work: threads, main loop, Zenoh.
//! - `children` are processes that end with this one: evaluators, and a sweep's learners.
//! - `page` shows runs in a browser.
//! - `report` summarizes scores as tables and figures.
//! - `judge` ranks policies without a simulator.
//! - `train` makes gradient steps.
//! - `service` is the state machine of a run's evaluations and online episodes. It does no input or
//!   output.
//! - `data` finds or fetches the data that a run learns from.

#![allow(missing_docs)]
#![deny(unsafe_code)]

mod children;
pub mod cli;
pub mod command;
mod data;
#[cfg(test)]
#[path = "../../run/src/fixtures.rs"]
mod fixtures;
mod judge;
mod live;
mod page;
mod report;
pub mod service;
mod sweep;
mod train;
