//! Fully connected networks act(x·W + b), K of one shape side by side.

pub(crate) mod config;
pub(crate) mod flat;
pub(crate) mod mlp;
pub(crate) mod network;
pub(crate) mod packed;
pub(crate) mod plain;
pub(crate) mod saved;
pub(crate) mod workspace;
