//! Networks in candle's own operations, which candle differentiates: those with a norm or wide layers
//! on a GPU, and the reference of all tests.

use crate::layers::flat::Layers;
use crate::weights::Tensors;
use candle_core::{D, Error, Result, Tensor};
use quad_kernels::activation::Activation;

/// x·tanh(softplus(x)) as x·n/(n + 2) with n = e^x (e^x + 2). From 20 on it is x to the last bit of
/// f32; the bound keeps value and derivative finite (the derivative of candle's Mish is NaN from 89
/// on).
pub(crate) fn mish(x: &Tensor) -> Result<Tensor> {
    // A tensor, since candle would send a number to the device each time.
    let e = x.minimum(&Tensor::full(20f32, x.shape(), x.device())?)?.exp()?;
    let n = (&e * (&e + 2.0)?)?;
    x * (&n / (&n + 2.0)?)?
}

pub(crate) fn activate(f: Activation, x: &Tensor) -> Result<Tensor> {
    match f {
        Activation::Mish => mish(x),
        // A maximum alone would drop a NaN.
        Activation::Relu => x.relu()? + (x * 0.0)?,
        Activation::Silu => x.silu(),
        Activation::Tanh => x.tanh(),
        Activation::Gelu => x.gelu(),
    }
}

/// (x − mean)/√(variance + ε)·scale + shift of each row, for `x [K, rows, width]`, scale and shift
/// `[K, 1, width]`. (candle-nn's layer norm has no gradient.)
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

pub(crate) fn named(weights: &Tensors, path: String) -> Result<&Tensor> {
    weights.get(&path).ok_or_else(|| Error::CannotFindTensor { path }.bt())
}

/// Layers `{prefix}0 …`: `x [1 or K, rows, in]` → `[K, rows, out]`.
pub(crate) fn mlp(weights: &Tensors, prefix: &str, layers: &Layers, x: &Tensor) -> Result<Tensor> {
    // `[K, in, out]` or `[K, 1, out]`
    let get = |layer: usize, kind: &str| {
        let path = format!("{prefix}{layer}.{kind}");
        let (inputs, outputs) = layers.shape(layer);
        let rows = if kind == "kernel" { inputs } else { 1 };
        named(weights, path)?.reshape((layers.members, rows, outputs))
    };
    let (mut x, config) = (x.clone(), &layers.config);
    for layer in 0..layers.count() {
        x = x.contiguous()?.broadcast_matmul(&get(layer, "kernel")?)?;
        x = x.broadcast_add(&get(layer, "bias")?)?;
        if layer + 1 == layers.count() {
            break;
        }
        let norm = |x: &Tensor| {
            let (scale, shift) = (get(layer, "scale")?, get(layer, "shift")?);
            layer_norm(x, &scale, &shift, config.norm_epsilon.value())
        };
        x = match (config.norm, config.norm_after) {
            (false, _) => activate(config.activation, &x)?,
            (true, false) => activate(config.activation, &norm(&x)?)?,
            (true, true) => norm(&activate(config.activation, &x)?)?,
        };
    }
    Ok(x)
}

/// Repeats each row: `[n, w]` → `[n·times, w]`.
pub(crate) fn repeat_rows(x: &Tensor, times: usize) -> Result<Tensor> {
    let (rows, width) = x.dims2()?;
    if times == 1 {
        return Ok(x.clone());
    }
    x.unsqueeze(1)?.broadcast_as((rows, times, width))?.reshape((rows * times, width))
}

/// Inputs `[n, width]` side by side, `[rows, …]`: the last has `rows`, and of others the first
/// rows/n rows get the first row, and so on.
pub(crate) fn side_by_side(inputs: &[&Tensor]) -> Result<Tensor> {
    let rows = inputs.last().map_or(Ok(0), |last| last.dim(0))?;
    let repeated = inputs.iter().map(|x| repeat_rows(x, rows / x.dim(0)?.max(1)));
    let repeated = repeated.collect::<Result<Vec<_>>>()?;
    if let [x] = &repeated[..] { Ok(x.clone()) } else { Tensor::cat(&repeated, 1) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::assert_within;
    use candle_core::Device;

    /// The variance of these rows is 1e-6, so that ε shows.
    #[test]
    fn layer_norm_matches_its_definition() -> Result<()> {
        let x = Tensor::new(&[[[5.001f32, 4.999]]], &Device::Cpu)?;
        let one = |x: f32| Tensor::full(x, (1, 1, 2), &Device::Cpu);
        for (epsilon, expected) in [(1e-6, 0.5f32.sqrt()), (1e-5, (1.0 / 11f32).sqrt())] {
            let y = layer_norm(&x, &one(2.0)?, &one(0.5)?, epsilon)?;
            let expected = [0.5 + 2.0 * expected, 0.5 - 2.0 * expected];
            let expected = Tensor::new(&[[expected]], x.device())?;
            assert_within(2e-4, "norm", &y, &expected);
        }
        Ok(())
    }
}
