//! The named tensors of a network, through each of which a gradient flows to the network's vector
//! of weights.

use crate::gradients::kept::KeptGradient;
use crate::slices::{read, slice};
use crate::weights::{Tensors, Weights};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};
use std::ops::Range;
use std::sync::Arc;

impl Weights {
    /// The named tensors. Where a gradient is taken of the weights, each leaves its own where the
    /// others' are kept: candle's views of a vector would each make a gradient as long as the
    /// vector.
    pub(crate) fn differentiable(&self) -> Result<Tensors> {
        let Some(kept) = self.kept_gradient() else {
            return self.layout().split(self.values(), "");
        };
        let mut start = 0;
        let tensor = |part: &crate::weights::TensorSpec| {
            let range = start..start + part.shape.iter().product::<usize>();
            start = range.end;
            let view = View { range, shape: part.shape.as_slice().into(), kept: kept.clone() };
            Ok((part.name.clone(), self.values().apply_op1(view)?))
        };
        self.layout().parts().iter().map(tensor).collect()
    }
}

/// The operation: a range of a vector, as a tensor of this shape.
struct View {
    range: Range<usize>,
    shape: Shape,
    /// Where the gradient of the whole vector is left.
    kept: Arc<KeptGradient>,
}

impl CustomOp1 for View {
    fn name(&self) -> &'static str {
        "part-of-the-weights"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let weights: &[f32] = slice(storage, layout)?;
        Ok((CpuStorage::F32(weights[self.range.clone()].to_vec()), self.shape.clone()))
    }

    fn bwd(&self, _: &Tensor, _: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        let gradient = gradient.contiguous()?;
        read(&gradient, |mine: &[f32]| {
            self.kept.write(self.range.clone(), |out| out.copy_from_slice(mine))
        })??;
        Ok(None)
    }
}
