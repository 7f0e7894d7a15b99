//! Diffuser's networks over trajectories.

pub(crate) mod config;
mod convolution;
mod group_norm;
mod layers;
pub(crate) mod networks;
