//! The tools that one person runs on one machine, each a command of its own: `collect`, `verify-dataset`, `score` and `film`.
//!
//! Owns nothing beyond a command's own files. Each runs on the calling thread and shares its episodes or rows among rayon's
//! threads, until it is done; the command line calls them. They use `sim`; they know nothing of the network.
//!
//! # Layout
//!
//! - [`collect`]: trains behaviour from random to competent and records it as a dataset.
//! - [`verify`]: replays a recorded dataset and measures how far the simulation is from it.
//! - `score`: scores saved policies.
//! - `film`: shows what one does.

pub mod collect;
pub(crate) mod film;
pub(crate) mod score;
pub mod verify;
