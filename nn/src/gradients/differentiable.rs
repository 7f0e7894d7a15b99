//! A network's named tensors, through each of which a gradient flows to its vector of weights.

use crate::gradients::buffer::GradientBuffer;
use crate::slices::{read, slice};
use crate::weights::{TensorSpec, Tensors, Weights};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use std::ops::Range;
use std::sync::Arc;

impl Weights {
    /// The named tensors, differentiable in the weights. The gradient of each goes to the
    /// [`GradientBuffer`]: through candle's views each would be as long as the whole vector.
    pub(crate) fn differentiable(&self) -> Result<Tensors> {
        let Some(buffer) = self.gradient_buffer() else {
            return self.layout().split(self.values(), "");
        };
        let mut start = 0;
        let tensor = |spec: &TensorSpec| {
            let range = start..start + spec.count();
            start = range.end;
            let view = View { range, shape: spec.shape.as_slice().into(), buffer: buffer.clone() };
            Ok((spec.name.clone(), self.values().apply_op1(view)?))
        };
        self.layout().specs().iter().map(tensor).collect()
    }
}

/// The operation that cuts a tensor of this shape out of a vector.
struct View {
    range: Range<usize>,
    shape: Shape,
    buffer: Arc<GradientBuffer>,
}

impl CustomOp1 for View {
    fn name(&self) -> &'static str {
        "view-of-weights"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let weights: &[f32] = slice(storage, layout)?;
        Ok((CpuStorage::F32(weights[self.range.clone()].to_vec()), self.shape.clone()))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        read(&gradient.contiguous()?, |gradient: &[f32]| {
            self.buffer.write(self.range.clone(), |out| out.copy_from_slice(gradient))
        })??;
        Ok(None)
    }
}
