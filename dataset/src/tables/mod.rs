//! Everything that is known by name, as embedded tables.
//!
//! [`environment`] has the simulated environments (`environments.toml`), by [`simulator`] of either
//! kind; [`benchmarks`] has D4RL and OGBench with their tasks in mazes (`benchmarks.toml`), by the
//! rules of [`maze`]; [`catalog`] has the datasets (`datasets.toml`). [`task`] is an environment
//! that may be unknown, [`reward`] the rules for recorded rewards.

pub mod benchmarks;
pub mod catalog;
pub mod environment;
pub mod maze;
pub mod reward;
pub mod simulator;
pub mod task;
