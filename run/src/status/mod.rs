//! How far runs are, by their folders alone.
//!
//! In reading order: `state` is the state of a run, `list` a table of all runs.

pub mod list;
mod state;

pub use state::{Pace, State};
