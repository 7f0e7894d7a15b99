//! Tensors that each update has anew, always the same number of them in the same shapes.

use candle_core::{Device, Result, Tensor};

/// The tensors of a batch or of the noise of an update.
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
