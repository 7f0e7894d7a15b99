//! Commands that need no network. Each runs on the calling thread and shares its episodes or rows
//! among rayon's threads.
//!
//! # Layout
//!
//! - [`collect`]: records policies, or behavior from random to competent that it trains, as a dataset.
//! - [`verify`]: replays a recorded dataset and measures how far the simulation is from it.
//! - `score`: scores saved policies.
//! - `film`: films saved policies.

pub mod collect;
pub mod film;
pub mod score;
pub mod verify;
