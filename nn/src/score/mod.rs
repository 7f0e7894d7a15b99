//! SfBC's score network and the DPM-Solver that samples from it.

mod dense;
mod dense_graph;
pub(crate) mod dpm_solver;
pub(crate) mod network;
