//! SfBC's score network and the DPM-Solver that samples it.

pub(crate) mod dense;
pub(crate) mod dense_graph;
pub(crate) mod dpm_solver;
pub(crate) mod network;
