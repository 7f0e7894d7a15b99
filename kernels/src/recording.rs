//! Work of an Nvidia GPU that is recorded once (a CUDA graph) and then started by one call of the
//! driver, where it took one for each kernel.

use crate::cuda::{CudaError, Result};
use cudarc::driver::sys::{CUgraphInstantiate_flags, CUresult, CUstreamCaptureMode};
use cudarc::driver::{CudaGraph, CudaStream, DriverError};
use std::sync::Arc;

/// Recorded work.
pub struct Recording(CudaGraph);

// SAFETY: graphs of the driver belong to no thread; and no two threads use one at once, since each
// use of it is exclusive.
unsafe impl Send for Recording {}

impl Recording {
    /// Records what `work` queues on a stream of this thread, none of which is done. It may not
    /// wait for the GPU, has to free what it allocates, and may free nothing else. Gives what
    /// `work` gives, too.
    pub fn of<R>(stream: &Arc<CudaStream>, work: impl FnOnce() -> R) -> (R, Result<Self>) {
        let begun = stream.begin_capture(CUstreamCaptureMode::CU_STREAM_CAPTURE_MODE_RELAXED);
        let result = work();
        let ended = begun.and_then(|()| stream.end_capture(CUgraphInstantiate_flags(0)));
        let nothing = || DriverError(CUresult::CUDA_ERROR_STREAM_CAPTURE_INVALIDATED);
        (
            result,
            ended.and_then(|graph| graph.ok_or_else(nothing)).map(Self).map_err(CudaError::from),
        )
    }

    /// Queues the recorded work, all of it.
    ///
    /// # Errors
    /// The driver refuses.
    pub fn replay(&mut self) -> Result<()> {
        Ok(self.0.launch()?)
    }
}
