//! Computing on an Nvidia GPU.

pub(crate) mod cuda_graph;
#[cfg(feature = "cuda")]
pub(crate) mod dense;
pub(crate) mod device;
#[cfg(feature = "cuda")]
pub(crate) mod numbers;
#[cfg(feature = "cuda")]
pub(crate) mod tensors;
