//! The work of an update: a GPU does it once, records it as a CUDA graph in the next update, and
//! replays that in those after it. It is hundreds of kernels, and the host takes longer to start one
//! of them than the GPU to run it.

use super::losses::{Computed, Loss, Measured, joined};
use candle_core::{DType, Device, Result, Tensor};
use quad_nn::{CudaGraph, overwrite};
use std::thread::{ThreadId, current};

/// Tensors that each update has anew, always the same number of them in the same shapes: those of a
/// batch, and the noise.
pub(super) trait Inputs: Clone {
    fn tensors(&mut self) -> Vec<&mut Tensor>;

    /// Copies them to a device.
    fn on(&self, device: &Device) -> Result<Self> {
        let mut inputs = self.clone();
        for tensor in inputs.tensors() {
            *tensor = tensor.to_device(device)?;
        }
        Ok(inputs)
    }
}

impl<A: Inputs, B: Inputs> Inputs for (A, B) {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let (mut tensors, more) = (self.0.tensors(), self.1.tensors());
        tensors.extend(more);
        tensors
    }
}

/// State between two updates.
struct Kept<I> {
    inputs: I,
    /// The vector of which the inputs are views on a GPU.
    numbers: Tensor,
    computed: Computed,
    /// `None` before the second update.
    recording: Option<CudaGraph>,
    /// The recording reads constants that belong to this thread.
    thread: ThreadId,
}

/// The work of an update on some inputs.
pub(super) struct Replay<I>(Option<Kept<I>>);

impl<I> Default for Replay<I> {
    fn default() -> Self {
        Self(None)
    }
}

impl<I: Inputs> Replay<I> {
    /// Does `work` on a device, or queues it there. On a GPU it must be the same each time but for the
    /// numbers of `inputs`, which are on the CPU; it changes tensors in place, and from the second
    /// time on no tensor that it makes may outlive it.
    pub fn start(
        &mut self,
        device: &Device,
        inputs: &I,
        work: impl FnOnce(&I) -> Result<Vec<Loss>>,
    ) -> Result<()> {
        let work = |inputs: &I| Computed::new(&work(inputs)?);
        let thread = current().id();
        let Some(mut kept) = self.0.take().filter(|kept| kept.thread == thread) else {
            let numbers = numbers(inputs)?.to_device(device)?;
            let inputs = views(inputs, &numbers)?;
            let computed = CudaGraph::warm_up(device, || work(&inputs))?;
            self.0 = Some(Kept { inputs, numbers, computed, recording: None, thread });
            return Ok(());
        };
        if !device.is_cuda() {
            kept.inputs = inputs.clone();
            kept.computed = work(inputs)?;
            self.0 = Some(kept);
            return Ok(());
        }
        // In place, where recorded work reads them.
        overwrite(&kept.numbers, &numbers(inputs)?)?;
        let mut copies = inputs.clone();
        for (tensor, new) in kept.inputs.tensors().into_iter().zip(copies.tensors()) {
            if new.dtype() != DType::F32 {
                overwrite(tensor, new)?;
            }
        }
        let Kept { inputs, computed, recording, .. } = &mut kept;
        let record = || computed.numbers.slice_set(&work(inputs)?.numbers, 0, 0);
        let mut recorded = match recording.take() {
            Some(recorded) => recorded,
            None => CudaGraph::capture(device, record)?,
        };
        recorded.replay()?;
        *recording = Some(recorded);
        self.0 = Some(kept);
        Ok(())
    }

    /// The results of the newest work, as [`Computed::read`] returns them.
    pub fn computed(&self) -> Result<(Measured, Vec<f32>)> {
        self.0.as_ref().map_or_else(|| Ok(Default::default()), |kept| kept.computed.read())
    }
}

/// The inputs' numbers of f32 in one vector, which one copy takes to a GPU.
fn numbers(inputs: &impl Inputs) -> Result<Tensor> {
    let mut inputs = inputs.clone();
    let tensors = inputs.tensors().into_iter().map(|x| &*x);
    joined(tensors.filter(|x| x.dtype() == DType::F32))
}

/// The inputs as views of a vector of [`numbers`]; those of other types are copied to its device.
fn views<I: Inputs>(inputs: &I, numbers: &Tensor) -> Result<I> {
    let (mut views, mut start) = (inputs.clone(), 0);
    for tensor in views.tensors() {
        let count = tensor.elem_count();
        if tensor.dtype() == DType::F32 {
            *tensor = numbers.narrow(0, start, count)?.reshape(tensor.shape())?;
            start += count;
        } else {
            *tensor = tensor.to_device(numbers.device())?;
        }
    }
    Ok(views)
}
