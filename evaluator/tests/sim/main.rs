//! Simulations, and batches of episodes in them.
#![allow(clippy::unwrap_used, clippy::print_stdout)]

mod edges;
mod gymnasium;
mod rollout;
