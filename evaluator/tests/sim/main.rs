//! Simulations, and batches of episodes in them.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod edges;
mod gymnasium;
#[path = "../../../tests/fixtures/python.rs"]
mod python;
mod rollout;
