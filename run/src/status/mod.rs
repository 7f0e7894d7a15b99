//! Progress of runs, by their folders alone.

pub mod list;
mod state;

pub use state::{Pace, State};
