//! Statistics of tensors, and losses.

use crate::slices::{has_fast_implementation, read};
use candle_core::{Result, Tensor};

/// Mean of (x − y)², `[]`, for x `[…]` or `[K, …]` and y `[…]`, which K members share. On a GPU y is a
/// constant.
pub fn squared_error(x: &Tensor, y: &Tensor) -> Result<Tensor> {
    #[cfg(feature = "cuda")]
    if x.device().is_cuda() {
        return crate::gpu::numbers::squared_error(x, y, None);
    }
    x.broadcast_sub(y)?.sqr()?.mean_all()
}

/// weight·E + mean(x·pull), and E = mean((x − y)²); both `[]`. The weight is `[]`; x, y and pull have
/// one shape. Only x has a gradient, on a GPU only through the first result.
pub fn pulled_error(
    x: &Tensor,
    y: &Tensor,
    weight: &Tensor,
    pull: &Tensor,
) -> Result<(Tensor, Tensor)> {
    #[cfg(feature = "cuda")]
    if x.device().is_cuda() {
        let pulled = crate::gpu::numbers::squared_error(x, y, Some([weight, pull]))?;
        return Ok((pulled, squared_error(&x.detach(), y)?));
    }
    let error = squared_error(x, y)?;
    Ok((((&error * weight)? + (x * pull)?.mean_all()?)?, error))
}

/// Mean and population variance over the first dimension: `[K, …]` → twice `[…]`, as constants.
pub fn mean_and_variance(x: &Tensor) -> Result<(Tensor, Tensor)> {
    let x = x.detach();
    if !has_fast_implementation(x.device()) {
        let mean = x.mean_keepdim(0)?;
        let variance = x.broadcast_sub(&mean)?.sqr()?.mean(0)?;
        return Ok((mean.squeeze(0)?, variance));
    }
    // Candle's own sums over a leading dimension take ten times as long.
    let (members, shape) = (x.dim(0)?, &x.dims()[1..]);
    let (mean, variance) = read(&x.contiguous()?, |x: &[f32]| {
        let share = 1.0 / members as f32;
        let mut mean = vec![0.0; x.len() / members];
        let mut variance = mean.clone();
        for member in x.chunks_exact(mean.len()) {
            mean.iter_mut().zip(member).for_each(|(mean, x)| *mean += x * share);
        }
        for member in x.chunks_exact(mean.len()) {
            for (sum, (x, mean)) in variance.iter_mut().zip(member.iter().zip(&mean)) {
                *sum += (x - mean) * (x - mean) * share;
            }
        }
        (mean, variance)
    })?;
    let tensor = |numbers| Tensor::from_vec(numbers, shape, x.device());
    Ok((tensor(mean)?, tensor(variance)?))
}
