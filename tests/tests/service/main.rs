//! How learners and evaluators work together: which runs an evaluator serves, what it does while it
//! waits, how both leave, and that many evaluators can work for one learner.
//!
//! CONTRIBUTING.md has a table of the long tests, which are ignored.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod crowds;
mod leaving;
mod local_evaluators;
mod names;
mod page;
mod runs;
mod sweep;
