//! The scoreboard under a clock of the test's own.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod audit;
mod bench;
#[path = "../common/mod.rs"]
mod common;
mod jobs;
mod leases;
mod reports;
