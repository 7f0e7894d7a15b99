//! Computing on an Nvidia GPU.

pub(crate) mod cuda_graph;
#[cfg(feature = "cuda")]
pub(crate) mod dense;
#[cfg(feature = "cuda")]
pub(crate) mod numbers;
#[cfg(feature = "cuda")]
pub(crate) mod tensors;

use candle_core::{Device, Result};

/// Opens this machine's first GPU.
///
/// # Errors
/// The driver finds no GPU, or this program was built without the feature `cuda`.
pub fn open_gpu() -> Result<Device> {
    let device = Device::new_cuda(0)?;
    #[cfg(feature = "cuda")]
    tensors::prepare(&device)?;
    Ok(device)
}
