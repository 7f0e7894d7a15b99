//! Datasets by name, and `learner datasets`.
//!
//! # Layout
//! In reading order: [`source`] is what `--dataset` means; [`cache`] is D4RL's folder of files; `fetch` gets a file of
//! the catalogue into it, from one address after the other; `transfer` is one attempt at one of them; `partial` is
//! what has arrived so far; `verify` tells whether it is the right file; `progress` shows how far it is.

pub mod cache;
mod fetch;
mod partial;
mod progress;
pub mod source;
mod transfer;
mod verify;

pub use source::{LocalDataset, Source};
