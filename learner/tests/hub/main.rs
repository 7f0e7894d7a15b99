//! The learner's side of the wire, spoken to by made-up evaluators over TCP.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod bench;
#[path = "../common/mod.rs"]
mod common;
mod jobs;
mod scores;
mod slow_peer;
mod weights;
