//! Simulations, batches of episodes in them, and the tools that record and replay.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod collect;
mod edges;
mod gymnasium;
mod rollout;
