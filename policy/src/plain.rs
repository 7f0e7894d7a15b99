//! The networks in plain candle operations, which candle differentiates: what runs on a GPU, and what the fast ones
//! on the CPU are tested against.

use crate::weights::Tensors;
use candle_core::{Result, Tensor};

/// x·tanh(softplus(x)) as x·n/(n + 2) with n = e^x (e^x + 2). From 20 on it is x, to the last bit of f32; the bound keeps
/// value and derivative finite everywhere (the derivative of candle's own Mish is NaN from 89 on).
fn mish(x: &Tensor) -> Result<Tensor> {
    // As a tensor, not a number: that would be sent to the device each time.
    let e = x.minimum(&Tensor::full(20f32, x.shape(), x.device())?)?.exp()?;
    let n = (&e * (&e + 2.0)?)?;
    x * (&n / (&n + 2.0)?)?
}

/// Linear layers `{name}0 … {name}{layers - 1}` with Mish between: `x · kernel + bias`. A leading number of members on the
/// weights is a batch dimension.
pub(crate) fn mlp(weights: &Tensors, name: &str, layers: usize, x: &Tensor) -> Result<Tensor> {
    let get = |layer: usize, kind: &str| {
        let path = format!("{name}{layer}.{kind}");
        weights.get(&path).ok_or_else(|| candle_core::Error::CannotFindTensor { path }.bt())
    };
    let mut x = x.clone();
    for layer in 0..layers {
        let (kernel, bias) = (get(layer, "kernel")?, get(layer, "bias")?);
        let bias = if bias.rank() == 2 { bias.unsqueeze(1)? } else { bias.clone() };
        x = x.contiguous()?.broadcast_matmul(kernel)?.broadcast_add(&bias)?;
        if layer + 1 < layers {
            x = mish(&x)?;
        }
    }
    Ok(x)
}

/// Each row `times` times, one after the other: `[n, w]` → `[n·times, w]`.
pub(crate) fn repeat_rows(x: &Tensor, times: usize) -> Result<Tensor> {
    let (rows, width) = x.dims2()?;
    x.unsqueeze(1)?.broadcast_as((rows, times, width))?.reshape((rows * times, width))
}
