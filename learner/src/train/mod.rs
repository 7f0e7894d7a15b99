//! Gradient steps. This module owns the algorithm during training, and the batches.
//!
//! All of it runs on the thread `training` (with rayon's pool for the arithmetic). That thread
//! never waits for a network or a metric, and for the disk only if far too much output is
//! unwritten: it puts its output into the [`OutputQueue`], from which the thread `snapshots` takes
//! it. The module `live` starts it.
//!
//! In reading order: `training` (the loop), `online` (the order of experience and gradient steps),
//! `agent`, `held_out` (metrics on episodes that are kept out), `output_queue`, `metrics`,
//! `results`. `cost` estimates the cost of a run, on its caller's thread.

mod agent;
mod cost;
mod held_out;
mod metrics;
mod online;
mod output_queue;
mod results;
#[cfg(test)]
mod tests;
mod training;

pub(crate) use agent::{begin, check_device, origin, resume};
pub(crate) use cost::RunCost;
pub(crate) use held_out::HeldOut;
pub(crate) use metrics::{OnlineMetrics, TrainingMetrics, metrics, register};
pub(crate) use online::{COLUMNS, Inbox, OnlineTraining};
pub(crate) use output_queue::{Output, OutputQueue};
pub(crate) use results::{Outcome, TrainedPolicy, held_out_name};
pub(crate) use training::Training;
