//! Diffuser's networks over windows of consecutive steps.

pub(crate) mod config;
pub(crate) mod convolution;
pub(crate) mod group_norm;
pub(crate) mod layers;
pub(crate) mod networks;
