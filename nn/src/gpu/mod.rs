//! Computing on an Nvidia GPU.

pub(crate) mod cuda_graph;
pub(crate) mod device;
#[cfg(feature = "cuda")]
pub(crate) mod tensors;
