//! Embedded tables of environments, benchmarks, tasks and datasets.

pub mod benchmarks;
pub mod catalog;
pub mod environment;
pub mod maze;
pub mod reward;
pub mod simulator;
pub mod task;
