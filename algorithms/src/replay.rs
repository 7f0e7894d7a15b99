//! The work of an update: a GPU does it once, records it in the next update, and replays it in those after that. It is hundreds
//! of kernels, and the host takes longer to start one of them than the GPU to run it.

use super::algorithm::{Measured, joined};
use candle_core::{Device, Result, Tensor};
use quad_policy::{Recording, overwrite};
use std::thread::{ThreadId, current};

/// Tensors that each update has of its own, always as many and in the same shapes.
pub(super) trait Inputs: Clone {
    fn tensors(&mut self) -> Vec<&mut Tensor>;
}

impl<A: Inputs, B: Inputs> Inputs for (A, B) {
    fn tensors(&mut self) -> Vec<&mut Tensor> {
        let (mut tensors, more) = (self.0.tensors(), self.1.tensors());
        tensors.extend(more);
        tensors
    }
}

/// What an update computes for its metrics.
pub(super) struct Computed {
    /// Names of the scalars.
    names: Vec<&'static str>,
    /// The scalars, then the other numbers, `[n]`.
    numbers: Tensor,
}

impl Computed {
    /// Scalars `[]` by name, and tensors of any shape.
    pub fn new(scalars: &[(&'static str, &Tensor)], others: &[&Tensor]) -> Result<Self> {
        let tensors: Vec<_> = scalars.iter().map(|(_, scalar)| *scalar).chain(others.iter().copied()).collect();
        Ok(Self { names: scalars.iter().map(|(name, _)| *name).collect(), numbers: joined(&tensors)? })
    }
}

/// What is kept from update to update.
struct Kept<I> {
    inputs: I,
    computed: Computed,
    /// None before the second update.
    recording: Option<Recording>,
    /// What is recorded reads constants that belong to this thread.
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
    /// Does `work` on a device, or queues it there. On a GPU that is the same each time but for the numbers of `inputs`, which
    /// are on the CPU after the first time. It changes tensors in place; from the second time on none that it makes outlives
    /// it.
    pub fn start(&mut self, device: &Device, inputs: &I, work: impl FnOnce(&I) -> Result<Computed>) -> Result<()> {
        let (mut inputs, thread) = (inputs.clone(), current().id());
        let Some(mut kept) = self.0.take().filter(|kept| device.is_cuda() && kept.thread == thread) else {
            for tensor in inputs.tensors() {
                *tensor = tensor.to_device(device)?;
            }
            let computed = Recording::rehearse(device, || work(&inputs))?;
            self.0 = Some(Kept { inputs, computed, recording: None, thread });
            return Ok(());
        };
        for (tensor, new) in kept.inputs.tensors().into_iter().zip(inputs.tensors()) {
            overwrite(tensor, new)?;
        }
        let Kept { inputs, computed, recording, .. } = &mut kept;
        let record = || computed.numbers.slice_set(&work(inputs)?.numbers, 0, 0);
        let mut recorded = match recording.take() {
            Some(recorded) => recorded,
            None => Recording::of(device, record)?,
        };
        recorded.replay()?;
        *recording = Some(recorded);
        self.0 = Some(kept);
        Ok(())
    }

    /// The scalars by name, and the other numbers; waits until they are computed.
    pub fn computed(&self) -> Result<(Measured, Vec<f32>)> {
        let Some(Kept { computed: Computed { names, numbers }, .. }) = &self.0 else { return Ok(Default::default()) };
        let mut scalars = numbers.to_vec1()?;
        let others = scalars.split_off(names.len());
        Ok((names.iter().copied().zip(scalars).collect(), others))
    }
}
