//! Work of a GPU that is recorded in one update and replayed in later ones.

use candle_core::{Device, Result, Tensor, bail};

/// Recorded work.
pub struct CudaGraph(#[cfg(feature = "cuda")] quad_kernels::recording::Recording);

impl CudaGraph {
    /// Does `work` as a rehearsal: what it sends to the GPU, sizes and constants, stays there for
    /// its recording.
    pub fn rehearse<R>(device: &Device, work: impl FnOnce() -> R) -> R {
        #[cfg(feature = "cuda")]
        let _kept = if let Device::Cuda(gpu) = device {
            Some(gpu.enable_cuda_graph_htod_cache())
        } else {
            None
        };
        let _ = device;
        work()
    }

    /// Records `work`, which was rehearsed on this thread, without doing it. It changes tensors
    /// that there are, and lets go of none of these and of all that it makes.
    ///
    /// # Errors
    /// `work` fails, or cannot be recorded.
    pub fn of(device: &Device, work: impl FnOnce() -> Result<()>) -> Result<Self> {
        #[cfg(feature = "cuda")]
        if let Device::Cuda(gpu) = device {
            let record = || quad_kernels::recording::Recording::of(&gpu.cuda_stream(), work);
            let (done, recording) = Self::rehearse(device, record);
            done?;
            return recording.map(Self).map_err(candle_core::Error::wrap);
        }
        Self::rehearse(device, work)?;
        bail!("work is recorded on a GPU only")
    }

    /// Queues the recorded work.
    ///
    /// # Errors
    /// The driver refuses.
    pub fn replay(&mut self) -> Result<()> {
        #[cfg(feature = "cuda")]
        self.0.replay().map_err(candle_core::Error::wrap)?;
        Ok(())
    }
}

/// Writes the numbers of a tensor on the CPU over those of one on a GPU.
///
/// # Errors
/// Another number of numbers or another type, or the driver refuses.
pub fn overwrite(tensor: &Tensor, with: &Tensor) -> Result<()> {
    #[cfg(feature = "cuda")]
    return match with.dtype() {
        candle_core::DType::U32 => crate::gpu::tensors::overwrite::<u32>(tensor, with),
        _ => crate::gpu::tensors::overwrite::<f32>(tensor, with),
    };
    #[cfg(not(feature = "cuda"))]
    bail!("{:?} is not on a GPU, and {:?} is not written over it", tensor.shape(), with.shape())
}
