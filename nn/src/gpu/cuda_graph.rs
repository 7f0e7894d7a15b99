//! Work of a GPU that is captured in one update and replayed in later ones.

use candle_core::{Device, Result, Tensor, bail};

/// Captured work.
pub struct CudaGraph(#[cfg(feature = "cuda")] quad_kernels::cuda_graph::CudaGraph);

impl CudaGraph {
    /// Does `work` before its capture. Sizes and constants that it sends to the GPU stay there.
    pub fn warm_up<R>(device: &Device, work: impl FnOnce() -> R) -> R {
        #[cfg(feature = "cuda")]
        let _cache = match device {
            Device::Cuda(gpu) => Some(gpu.enable_cuda_graph_htod_cache()),
            _ => None,
        };
        let _ = device;
        work()
    }

    /// Captures `work`, which was warmed up on this thread, without doing it. It may change existing
    /// tensors but free none of them, and must free all that it makes.
    pub fn capture(device: &Device, work: impl FnOnce() -> Result<()>) -> Result<Self> {
        #[cfg(feature = "cuda")]
        if let Device::Cuda(gpu) = device {
            let stream = gpu.cuda_stream();
            let capture = || quad_kernels::cuda_graph::CudaGraph::capture(&stream, work);
            let (done, graph) = Self::warm_up(device, capture);
            done?;
            return graph.map(Self).map_err(candle_core::Error::wrap);
        }
        Self::warm_up(device, work)?;
        bail!("work is captured on a GPU only")
    }

    /// Queues the captured work.
    pub fn replay(&mut self) -> Result<()> {
        #[cfg(feature = "cuda")]
        self.0.launch().map_err(candle_core::Error::wrap)?;
        Ok(())
    }
}

/// Overwrites the numbers of a tensor on a GPU by those of one on the CPU, of the same type and
/// number.
pub fn overwrite(tensor: &Tensor, with: &Tensor) -> Result<()> {
    #[cfg(feature = "cuda")]
    return match with.dtype() {
        candle_core::DType::U32 => crate::gpu::tensors::overwrite::<u32>(tensor, with),
        _ => crate::gpu::tensors::overwrite::<f32>(tensor, with),
    };
    #[cfg(not(feature = "cuda"))]
    bail!("{:?} is not on a GPU, and {:?} is not written over it", tensor.shape(), with.shape())
}
