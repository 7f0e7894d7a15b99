//! Opening the GPU.

use candle_core::{Device, Result};

/// Opens this machine's first GPU.
///
/// # Errors
/// The driver finds no GPU, or this program was built without the feature `cuda`.
pub fn open_gpu() -> Result<Device> {
    let device = Device::new_cuda(0)?;
    #[cfg(feature = "cuda")]
    crate::gpu::tensors::prepare(&device)?;
    Ok(device)
}
