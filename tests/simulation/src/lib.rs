//! The service in a simulation: one learner and up to 64 evaluators as state machines, with virtual
//! time, a network, a disk and strangers. Every choice follows from a seed.
//!
//! Invariants of any schedule: each episode of an evaluation counts once, with the first bits
//! that are on the disk; each online episode is recorded once; training takes them in their order, so
//! that its weights are those of a run without faults; nothing that was acknowledged is lost, nor
//! given up by an evaluator before; nothing is played needlessly; and the run ends, without its
//! scores only if no evaluator is there.
//!
//! # Layout
//! `world` has time and the order of events, `checks` the invariants, `network` the messages,
//! `settings` a run and its faults; `learner`, `training` and `disk` are a learner's process,
//! `evaluator` is an evaluator's, `arithmetic` what they compute; `strangers` send nonsense.

#![allow(missing_docs, clippy::expect_used)] // A test.

mod arithmetic;
mod checks;
mod disk;
mod evaluator;
mod learner;
mod network;
mod settings;
mod strangers;
mod training;
mod world;

use std::panic::{AssertUnwindSafe, catch_unwind};

use world::World;

/// Runs a seed. An error says what does not hold.
pub fn run(seed: u64) -> Result<(), String> {
    let run = catch_unwind(|| World::new(seed, false).run());
    run.unwrap_or_else(|_| Err("it panicked".to_owned()))
}

/// Runs a seed with a trace: its settings, all that happens, and the result.
pub fn trace(seed: u64) -> (String, Vec<String>, Result<(), String>) {
    let mut world = World::new(seed, true);
    let result = catch_unwind(AssertUnwindSafe(|| world.run()));
    let result = result.unwrap_or_else(|_| Err("it panicked".to_owned()));
    let settings = format!("{:#?}", world.settings);
    (settings, world.trace.take().unwrap_or_default(), result)
}
