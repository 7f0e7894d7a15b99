//! Learners and evaluators at work together, and how both leave.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod leaving;
mod local_evaluators;
mod page;
mod runs;
mod sweep;
