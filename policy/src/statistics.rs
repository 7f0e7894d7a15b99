//! Mean and variance over the members of an ensemble.

use crate::slices::{has_fast_implementation, slice};
use candle_core::{CpuStorage, CustomOp1, Layout, Result, Shape, Tensor};

/// Mean and population variance over the first dimension: `[K, …]` → twice `[…]`, as constants.
pub fn mean_and_variance(x: &Tensor) -> Result<(Tensor, Tensor)> {
    let x = x.detach();
    if !has_fast_implementation(x.device()) {
        return plain_mean_and_variance(&x);
    }
    // Candle's own sums over a leading dimension take ten times as long.
    let both = x.contiguous()?.apply_op1_no_bwd(&MeanAndVariance)?;
    Ok((both.get(0)?, both.get(1)?))
}

fn plain_mean_and_variance(x: &Tensor) -> Result<(Tensor, Tensor)> {
    let mean = x.mean_keepdim(0)?;
    let variance = x.broadcast_sub(&mean)?.sqr()?.mean(0)?;
    Ok((mean.squeeze(0)?, variance))
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
            variance.iter_mut().zip(squares).for_each(|(variance, square)| *variance += square * share);
        }
        Ok((CpuStorage::F32(out), dims.into()))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use candle_core::Device;

    #[test]
    fn both_implementations_do_the_same() {
        for dims in [vec![1, 4], vec![3, 7], vec![10, 5, 3]] {
            let numbers: Vec<f32> = (0..dims.iter().product()).map(|i: usize| (i as f32 * 1.7).sin()).collect();
            let x = Tensor::from_vec(numbers, dims, &Device::Cpu).unwrap();
            let ((a, b), (c, d)) = (mean_and_variance(&x).unwrap(), plain_mean_and_variance(&x).unwrap());
            for (fast, plain) in [(a, c), (b, d)] {
                assert_eq!(fast.dims(), plain.dims());
                let difference = (fast - plain).unwrap().abs().unwrap().max_all().unwrap();
                assert!(difference.to_scalar::<f32>().unwrap() < 1e-6);
            }
        }
    }
}
