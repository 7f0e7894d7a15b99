//! The networks in candle's own tensors: the readable version, differentiable by candle's autograd and run on any of
//! its devices. The fast version next door is tested against it.

use crate::Schedule;
use candle_core::{DType, Device, Result, Tensor};
use std::collections::BTreeMap;

/// x·tanh(softplus(x)) as x·n/(n + 2) with n = e^x (e^x + 2). From 20 on it is x, to the last bit of f32; the bound keeps
/// value and derivative finite everywhere (the derivative of candle's own Mish is NaN from 89 on).
pub fn mish(x: &Tensor) -> Result<Tensor> {
    // As a tensor, not a number: that would be sent to the device each time.
    let e = x.minimum(&Tensor::full(20f32, x.shape(), x.device())?)?.exp()?;
    let n = (&e * (&e + 2.0)?)?;
    x * (&n / (&n + 2.0)?)?
}

/// Named tensors of a network (see [`crate::Parameters`] for the names).
pub type Tensors = BTreeMap<String, Tensor>;

/// `x · kernel + bias`; a leading K on the weights is a batch dimension.
fn linear(weights: &Tensors, name: &str, x: &Tensor) -> Result<Tensor> {
    let get = |kind: &str| {
        let name = format!("{name}.{kind}");
        weights.get(&name).ok_or_else(|| candle_core::Error::CannotFindTensor { path: name }.bt())
    };
    let (kernel, bias) = (get("kernel")?, get("bias")?);
    let bias = if bias.rank() == 2 { bias.unsqueeze(1)? } else { bias.clone() };
    x.contiguous()?.broadcast_matmul(kernel)?.broadcast_add(&bias)
}

/// Linear layers `name.0 … name.{layers - 1}` with Mish between.
fn mlp(weights: &Tensors, name: &str, layers: usize, x: &Tensor) -> Result<Tensor> {
    let mut x = linear(weights, &format!("{name}.0"), x)?;
    for layer in 1..layers {
        x = linear(weights, &format!("{name}.{layer}"), &mish(&x)?)?;
    }
    Ok(x)
}

/// Sinusoids of t, `[B]` (f32) → `[B, 16]`: cosines, then sines, of t·exp(-k·ln(10000)/7).
fn time_features(t: &Tensor) -> Result<Tensor> {
    let frequencies: Vec<f32> = (0..8).map(|k| (-f64::from(k) * 10_000_f64.ln() / 7.0).exp() as f32).collect();
    let angles = t.unsqueeze(1)?.broadcast_mul(&Tensor::new(frequencies, t.device())?.unsqueeze(0)?)?;
    Tensor::cat(&[angles.cos()?, angles.sin()?], 1)
}

/// ε_θ(a^t, s, t): `actions [B, a]`, `observations [B, o]`, `t [B]` → `[B, a]`.
pub fn noise(weights: &Tensors, observations: &Tensor, actions: &Tensor, t: &Tensor) -> Result<Tensor> {
    let time = mlp(weights, "actor.time", 2, &time_features(&t.to_dtype(DType::F32)?)?)?;
    mlp(weights, "actor.trunk", 4, &Tensor::cat(&[observations, actions, &time], 1)?)
}

/// Q_k(s, a): `observations [B, o]`; `actions [B, a]`, or `[K, B, a]` with actions for each critic → `[K, B]`.
pub fn values(weights: &Tensors, observations: &Tensor, actions: &Tensor) -> Result<Tensor> {
    let actions = if actions.rank() == 2 { actions.unsqueeze(0)? } else { actions.clone() };
    let observations = observations.broadcast_left(actions.dim(0)?)?;
    let input = Tensor::cat(&[observations, actions], 2)?;
    mlp(weights, "critic", 4, &input)?.squeeze(2)
}

/// Draws actions by the reverse process: `observations [B, o]`, `draws [T, B, a]` → `[B, a]`.
pub fn sample(schedule: &Schedule, weights: &Tensors, observations: &Tensor, draws: &Tensor) -> Result<Tensor> {
    let mut actions = draws.get(0)?;
    let mut alpha_bar_before: Vec<f64> = vec![1.0];
    alpha_bar_before.extend(schedule.alpha_bar.iter().map(|x| f64::from(*x)));
    for t in (1..=schedule.steps()).rev() {
        let (alpha_bar, before) = (alpha_bar_before[t], alpha_bar_before[t - 1]);
        let beta = f64::from(schedule.beta[t - 1]);
        let steps = Tensor::full(t as f32, actions.dim(0)?, actions.device())?;
        let epsilon = noise(weights, observations, &actions, &steps)?;
        let clean = ((&actions - (epsilon * (1.0 - alpha_bar).sqrt())?)? / alpha_bar.sqrt())?.clamp(-1f32, 1f32)?;
        let from_clean = before.sqrt() * beta / (1.0 - alpha_bar);
        let from_noisy = (1.0 - beta).sqrt() * (1.0 - before) / (1.0 - alpha_bar);
        actions = ((clean * from_clean)? + (actions * from_noisy)?)?;
        if t > 1 {
            actions = (actions + (draws.get(schedule.steps() - t + 1)? * beta.sqrt())?)?;
        }
    }
    Ok(actions)
}

/// Loads a safetensors file's tensors onto a device.
pub fn load(bytes: &[u8], device: &Device) -> Result<Tensors> {
    Ok(candle_core::safetensors::load_buffer(bytes, device)?.into_iter().collect())
}
