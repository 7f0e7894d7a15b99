//! The work of an update: a GPU does it once, records it in the next update, and replays it in
//! those after that. It is hundreds of kernels, and the host takes longer to start one of them than
//! the GPU to run it.

use super::algorithm::{Loss, Measured, joined, scalars};
use candle_core::{Device, Result, Tensor};
use quad_nn::{CudaGraph, overwrite};
use std::thread::{ThreadId, current};

/// Tensors that each update has of its own, always as many and in the same shapes.
pub(super) trait Inputs: Clone {
    fn tensors(&mut self) -> Vec<&mut Tensor>;

    /// They on a device.
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

/// What an update computes for its metrics.
pub(super) struct Computed {
    /// Names of the scalars.
    names: Vec<&'static str>,
    /// The scalars, then the other numbers, `[n]`.
    numbers: Tensor,
}

impl Computed {
    /// What some losses measure, and tensors of any shape.
    pub fn new(losses: &[Loss], others: &[&Tensor]) -> Result<Self> {
        let tensors: Vec<_> =
            scalars(losses).map(|(_, scalar)| scalar).chain(others.iter().copied()).collect();
        Ok(Self {
            names: scalars(losses).map(|(name, _)| *name).collect(),
            numbers: joined(&tensors)?,
        })
    }

    /// The scalars by name, and the other numbers; waits until they are computed.
    pub fn read(&self) -> Result<(Measured, Vec<f32>)> {
        let mut scalars = self.numbers.to_vec1()?;
        let others = scalars.split_off(self.names.len());
        Ok((self.names.iter().copied().zip(scalars).collect(), others))
    }
}

/// What is kept from update to update.
struct Kept<I> {
    inputs: I,
    computed: Computed,
    /// None before the second update.
    recording: Option<CudaGraph>,
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
    /// Does `work` on a device, or queues it there. On a GPU that is the same each time but for the
    /// numbers of `inputs`, which are on the CPU after the first time. It changes tensors in place;
    /// from the second time on none that it makes outlives it.
    pub fn start(
        &mut self,
        device: &Device,
        inputs: &I,
        work: impl FnOnce(&I) -> Result<Computed>,
    ) -> Result<()> {
        let thread = current().id();
        let Some(mut kept) = self.0.take().filter(|kept| kept.thread == thread) else {
            let inputs = inputs.on(device)?;
            let computed = CudaGraph::rehearse(device, || work(&inputs))?;
            self.0 = Some(Kept { inputs, computed, recording: None, thread });
            return Ok(());
        };
        for (tensor, new) in kept.inputs.tensors().into_iter().zip(inputs.clone().tensors()) {
            renew(tensor, new)?;
        }
        let Kept { inputs, computed, recording, .. } = &mut kept;
        if !device.is_cuda() {
            *computed = work(inputs)?;
            self.0 = Some(kept);
            return Ok(());
        }
        let record = || computed.numbers.slice_set(&work(inputs)?.numbers, 0, 0);
        let mut recorded = match recording.take() {
            Some(recorded) => recorded,
            None => CudaGraph::of(device, record)?,
        };
        recorded.replay()?;
        *recording = Some(recorded);
        self.0 = Some(kept);
        Ok(())
    }

    /// What the newest work computed, as [`Computed::read`] gives it.
    pub fn computed(&self) -> Result<(Measured, Vec<f32>)> {
        self.0.as_ref().map_or_else(|| Ok(Default::default()), |kept| kept.computed.read())
    }
}

/// Gives a tensor of an earlier update the numbers of a new one: in place on a GPU, where recorded
/// work reads it.
fn renew(tensor: &mut Tensor, new: &Tensor) -> Result<()> {
    if tensor.device().is_cuda() {
        return overwrite(tensor, new);
    }
    *tensor = new.clone();
    Ok(())
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[derive(Clone)]
    struct One(Tensor);

    impl Inputs for One {
        fn tensors(&mut self) -> Vec<&mut Tensor> {
            vec![&mut self.0]
        }
    }

    #[test]
    fn each_update_has_its_own_inputs() {
        let mut replay = Replay::default();
        for number in [1.0, 2.0, 3.0] {
            let inputs = One(Tensor::new(number, &Device::Cpu).unwrap());
            let work = |One(x): &One| Computed::new(&[Loss::new("x", x.clone())], &[x]);
            replay.start(&Device::Cpu, &inputs, work).unwrap();
            assert_eq!(replay.computed().unwrap(), (vec![("x", number)], vec![number]));
        }
    }
}
