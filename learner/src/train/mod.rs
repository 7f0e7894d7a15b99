//! Gradient steps. This module owns the algorithm during training, and the batches.
//!
//! All of it runs on the thread `training` (with rayon's pool for the arithmetic). That thread
//! never waits for a network or a metric, and for the disk only if far too much output is
//! unwritten: it puts its output into the [`Outbox`], from which the thread `snapshots` takes it.
//! The module `live` starts it.
//!
//! In reading order: `training` (the thread's work), `steps` (the loop), `device` (where it
//! computes), `results`, `outbox`, `metrics`. Beside them, `held_out` measures on episodes that are
//! kept out, and `price` estimates what a run costs, on its caller's thread.

pub(crate) mod device;
mod held_out;
mod metrics;
mod outbox;
mod price;
mod results;
mod steps;
#[cfg(test)]
mod tests;
mod training;

pub(crate) use held_out::HeldOut;
pub(crate) use metrics::{Registrar, TrainingMetrics};
pub(crate) use outbox::{Outbox, Work};
pub(crate) use price::Price;
pub(crate) use results::{Outcome, TrainedPolicy};
pub(crate) use training::{Training, begin};
