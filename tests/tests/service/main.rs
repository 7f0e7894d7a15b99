//! Learners and evaluators at work together, and how both leave.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod crowds;
mod leaving;
mod local_evaluators;
mod names;
mod online;
mod page;
mod runs;
mod sweep;
