//! Mean and variance over the members of an ensemble.

use crate::slices::{has_fast_implementation, slice};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// Mean and population variance over the first dimension: `[K, …]` → twice `[…]`, as constants.
pub fn mean_and_variance(x: &Tensor) -> Result<(Tensor, Tensor)> {
    let x = x.detach();
    if !has_fast_implementation(x.device()) {
        let mean = x.mean_keepdim(0)?;
        let variance = x.broadcast_sub(&mean)?.sqr()?.mean(0)?;
        return Ok((mean.squeeze(0)?, variance));
    }
    // Candle's own sums over a leading dimension take ten times as long.
    let both = x.contiguous()?.apply_op1_no_bwd(&MeanAndVariance)?;
    Ok((both.get(0)?, both.get(1)?))
}

struct MeanAndVariance;

impl CustomOp1 for MeanAndVariance {
    fn name(&self) -> &'static str {
        "mean-and-variance"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let x: &[f32] = slice(storage, layout)?;
        let mut dims = layout.dims().to_vec();
        let members = std::mem::replace(&mut dims[0], 2);
        let count = x.len() / members;
        let mut out = vec![0.0; 2 * count];
        let (mean, variance) = out.split_at_mut(count);
        let share = 1.0 / members as f32;
        for member in x.chunks_exact(count) {
            mean.iter_mut().zip(member).for_each(|(mean, x)| *mean += x * share);
        }
        for member in x.chunks_exact(count) {
            let squares = member.iter().zip(&*mean).map(|(x, mean)| (x - mean) * (x - mean));
            variance
                .iter_mut()
                .zip(squares)
                .for_each(|(variance, square)| *variance += square * share);
        }
        Ok((CpuStorage::F32(out), dims.into()))
    }
}
