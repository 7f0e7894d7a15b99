//! No peer can come in without a certificate, act in another role, take memory, or stop the work.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)]

mod access;
mod roles;
mod strangers;
