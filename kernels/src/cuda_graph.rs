//! Work of an Nvidia GPU captured as a CUDA graph, which one call of the driver starts instead of
//! one for each kernel.

use crate::cuda_kernels::{CudaError, Result};
use cudarc::driver::sys::{CUgraphInstantiate_flags, CUresult, CUstreamCaptureMode};
use cudarc::driver::{CudaStream, DriverError};
use std::sync::Arc;

/// A captured graph.
pub struct CudaGraph(cudarc::driver::CudaGraph);

// SAFETY: graphs of the driver belong to no thread, and every use of one is exclusive.
unsafe impl Send for CudaGraph {}

impl CudaGraph {
    /// Captures the work that `work` queues on a stream of this thread, without doing it. `work` may
    /// not wait for the GPU, has to free what it allocates, and may free nothing else. Returns its
    /// result, too.
    pub fn capture<R>(stream: &Arc<CudaStream>, work: impl FnOnce() -> R) -> (R, Result<Self>) {
        let begun = stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED);
        let result = work();
        let ended = begun.and_then(|()| stream.end_capture(CUgraphInstantiate_flags(0)));
        let nothing = || DriverError(CUresult::CUDA_ERROR_STREAM_CAPTURE_INVALIDATED);
        let graph = ended.and_then(|graph| graph.ok_or_else(nothing));
        (result, graph.map(Self).map_err(CudaError::from))
    }

    /// Queues the captured work.
    pub fn launch(&mut self) -> Result<()> {
        Ok(self.0.launch()?)
    }
}
