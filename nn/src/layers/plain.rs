//! The networks in plain candle operations, which candle differentiates: on a GPU those with a
//! norm, and what the others are tested against.

use crate::layers::flat::Layers;
use crate::weights::Tensors;
use candle_core::{D, Result, Tensor};
use quad_kernels::activation::Activation;

/// x·tanh(softplus(x)) as x·n/(n + 2) with n = e^x (e^x + 2). From 20 on it is x, to the last bit
/// of f32; the bound keeps value and derivative finite everywhere (the derivative of candle's own
/// Mish is NaN from 89 on).
pub(crate) fn mish(x: &Tensor) -> Result<Tensor> {
    // As a tensor, not a number: that would be sent to the device each time.
    let e = x.minimum(&Tensor::full(20f32, x.shape(), x.device())?)?.exp()?;
    let n = (&e * (&e + 2.0)?)?;
    x * (&n / (&n + 2.0)?)?
}

pub(crate) fn activate(f: Activation, x: &Tensor) -> Result<Tensor> {
    match f {
        Activation::Mish => mish(x),
        // A maximum would drop a NaN; zero times x lets none get lost.
        Activation::Relu => x.relu()? + (x * 0.0)?,
        Activation::Silu => x.silu(),
        Activation::Tanh => x.tanh(),
        Activation::Gelu => x.gelu(),
    }
}

/// Each row over its numbers: (x - mean)/√(variance + ε)·scale + shift, for `x [K, rows, width]`
/// and `[K, 1, width]`. (candle-nn's own has no gradient, and says nothing.)
pub(crate) fn layer_norm(
    x: &Tensor,
    scale: &Tensor,
    shift: &Tensor,
    epsilon: f64,
) -> Result<Tensor> {
    let centered = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
    let deviation = (centered.sqr()?.mean_keepdim(D::Minus1)? + epsilon)?.sqrt()?;
    centered.broadcast_div(&deviation)?.broadcast_mul(scale)?.broadcast_add(shift)
}

/// Layers `{prefix}0 …`: `x [1 or K, rows, in]` → `[K, rows, out]`.
pub(crate) fn mlp(weights: &Tensors, prefix: &str, layers: &Layers, x: &Tensor) -> Result<Tensor> {
    // `[K, in, out]` or `[K, 1, out]`, whether the tensors are named as members' or as one
    // network's.
    let get = |layer: usize, kind: &str| {
        let path = format!("{prefix}{layer}.{kind}");
        let tensor =
            weights.get(&path).ok_or_else(|| candle_core::Error::CannotFindTensor { path }.bt())?;
        let rows = if kind == "kernel" { layers.shape(layer).0 } else { 1 };
        tensor.reshape((layers.members, rows, layers.shape(layer).1))
    };
    let mut x = x.clone();
    for layer in 0..layers.count() {
        x = x
            .contiguous()?
            .broadcast_matmul(&get(layer, "kernel")?)?
            .broadcast_add(&get(layer, "bias")?)?;
        if layer + 1 == layers.count() {
            break;
        }
        if !layers.norm {
            x = activate(layers.activation, &x)?;
            continue;
        }
        let norm = |x: &Tensor| {
            layer_norm(x, &get(layer, "scale")?, &get(layer, "shift")?, layers.norm_epsilon.value())
        };
        x = match layers.norm_after {
            false => activate(layers.activation, &norm(&x)?)?,
            true => norm(&activate(layers.activation, &x)?)?,
        };
    }
    Ok(x)
}

/// Each row `times` times, one after the other: `[n, w]` → `[n·times, w]`.
pub(crate) fn repeat_rows(x: &Tensor, times: usize) -> Result<Tensor> {
    let (rows, width) = x.dims2()?;
    if times == 1 {
        return Ok(x.clone());
    }
    x.unsqueeze(1)?.broadcast_as((rows, times, width))?.reshape((rows * times, width))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use candle_core::Device;

    /// Rows of variance 1e-6, in which it shows what is added to it.
    #[test]
    fn a_norm_divides_by_the_root_of_the_variance_and_what_it_adds() {
        let x = Tensor::new(&[[[5.001f32, 4.999]]], &Device::Cpu).unwrap();
        let one = |x: f32| Tensor::full(x, (1, 1, 2), &Device::Cpu).unwrap();
        for (epsilon, expected) in [(1e-6, 0.5f64.sqrt()), (1e-5, (1.0 / 11.0f64).sqrt())] {
            let y = layer_norm(&x, &one(2.0), &one(0.5), epsilon).unwrap();
            let y: Vec<f32> = y.flatten_all().unwrap().to_vec1().unwrap();
            let expected = [0.5 + 2.0 * expected, 0.5 - 2.0 * expected];
            assert!(
                y.iter().zip(expected).all(|(y, x)| (f64::from(*y) - x).abs() < 1e-3),
                "{y:?} {expected:?}"
            );
        }
    }
}
