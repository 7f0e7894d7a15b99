//! No peer can connect without a certificate, act in another role, take unbounded memory, stop the
//! work, or lose or double a score.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod access;
mod floods;
mod nonsense;
mod roles;
mod silence;
