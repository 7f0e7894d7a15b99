//! Fully connected networks: K of them as one operation, on a CPU, on a GPU and plainly.

pub(crate) mod action_gradients;
pub(crate) mod composed;
pub(crate) mod config;
pub(crate) mod flat;
pub(crate) mod mlp;
pub(crate) mod network;
pub(crate) mod operation;
pub(crate) mod packed;
pub(crate) mod plain;
pub(crate) mod saved;
pub(crate) mod workspace;
