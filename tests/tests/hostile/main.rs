//! What an evaluator, a peer or a learner must not be able to do: come in without a certificate, do
//! what another role is for, take unbounded memory, stop the work, or lose or double a score.
//!
//! CONTRIBUTING.md has a table of the long tests, which are ignored.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod access;
mod floods;
mod nonsense;
mod roles;
mod silence;
