//! Messages on the wire: they survive it, and whatever else comes is an error of bounded cost.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod allocation;
mod frames;
mod mutations;
mod wire;
