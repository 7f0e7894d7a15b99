//! Tools for one machine, each a command of its own: `collect`, `verify-dataset`, `score` and
//! `film`.
//!
//! Owns only the files of a command. Each command runs on the calling thread and shares its
//! episodes or rows among rayon's threads. The command line calls this module; it uses `sim`, and
//! knows nothing of the network.
//!
//! # Layout
//!
//! - [`collect`]: trains behavior from random to competent and records it as a dataset.
//! - [`verify`]: replays a recorded dataset and measures how far the simulation is from it.
//! - `score`: scores saved policies.
//! - `film`: films saved policies.

pub mod collect;
pub(crate) mod film;
pub(crate) mod score;
pub mod verify;
