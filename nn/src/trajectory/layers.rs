//! The layers of networks over windows `[B, L, C]`, by the names of their tensors (which `window`
//! lists).

use crate::layers::plain::{layer_norm, mish};
use crate::trajectory::config::{Attention, TrajectoryConfig};
use crate::trajectory::convolution::{convolve, double};
use crate::trajectory::group_norm::normed_mish;
use crate::weights::{Tensors, Weights};
use candle_core::{Device, Error, Result, Tensor};

/// Added to the variance of attention's layer norm.
const EPSILON: f64 = 1e-5;

/// The layers of one network, and what all of them take.
pub(crate) struct Layers<'a> {
    tensors: Tensors,
    config: &'a TrajectoryConfig,
}

/// Embeddings of a denoising step for each window, `[B, 1, embedding]`: as it is, and through Mish.
pub(crate) struct Time {
    pub embedding: Tensor,
    activated: Tensor,
}

impl<'a> Layers<'a> {
    pub fn new(weights: &Weights, config: &'a TrajectoryConfig) -> Result<Self> {
        Ok(Self { tensors: weights.differentiable()?, config })
    }

    fn get(&self, name: &str, kind: &str) -> Result<&Tensor> {
        let path = format!("{name}.{kind}");
        self.tensors.get(&path).ok_or_else(|| Error::CannotFindTensor { path }.bt())
    }

    /// The embedding of t, in 1..=T, of each window: sines, then cosines, of (t − 1)·f_k, f_k from
    /// 1 down to 10⁻⁴, through two layers.
    pub fn time(&self, t: &[u32], device: &Device) -> Result<Time> {
        let half = self.config.channels / 2;
        let angle = |t: u32, k: usize| {
            f64::from(t - 1) * (-(k as f64) * 10_000_f64.ln() / (half - 1) as f64).exp()
        };
        let row = |t: &u32| {
            let t = *t;
            (0..half)
                .map(move |k| angle(t, k).sin())
                .chain((0..half).map(move |k| angle(t, k).cos()))
        };
        let features: Vec<f32> = t.iter().flat_map(row).map(|x| x as f32).collect();
        let features = Tensor::from_vec(features, (t.len(), 1, 2 * half), device)?;
        let embedding = self.linear("time.1", &mish(&self.linear("time.0", &features)?)?)?;
        Ok(Time { activated: mish(&embedding)?, embedding })
    }

    /// x·kernel + bias of each step.
    pub fn linear(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        convolve(x, &self.get(name, "kernel")?.unsqueeze(0)?, self.get(name, "bias")?, 1)
    }

    /// A convolution, group norm, Mish.
    pub fn normed(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let x = convolve(x, self.get(name, "kernel")?, self.get(name, "bias")?, 1)?;
        normed_mish(&x, self.get(name, "scale")?, self.get(name, "shift")?, self.config.groups)
    }

    /// A residual block.
    pub fn block(&self, name: &str, x: &Tensor, time: &Time) -> Result<Tensor> {
        let of_time = self.linear(&format!("{name}.time"), &time.activated)?;
        let inside = self.normed(&format!("{name}.0"), x)?.broadcast_add(&of_time)?;
        let inside = self.normed(&format!("{name}.1"), &inside)?;
        let skip = format!("{name}.skip");
        if self.tensors.contains_key(&format!("{skip}.kernel")) {
            inside + self.linear(&skip, x)?
        } else {
            inside + x
        }
    }

    /// Every second step of a convolution.
    pub fn halve(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        convolve(x, self.get(name, "kernel")?, self.get(name, "bias")?, 2)
    }

    /// Twice the steps.
    pub fn double(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        double(x, self.get(name, "kernel")?, self.get(name, "bias")?)
    }

    /// x plus linear attention (Shen et al. 2021) of its layer norm, if the configuration has it:
    /// keys are softened over the steps, and what they gather of the values is read by the queries.
    pub fn attend(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let Some(Attention { heads, width }) = self.config.attention else { return Ok(x.clone()) };
        let (windows, length, _) = x.dims3()?;
        let normed = layer_norm(x, self.get(name, "scale")?, self.get(name, "shift")?, EPSILON)?;
        let kernel = self.get(name, "queries.kernel")?;
        let none = Tensor::zeros(kernel.dim(1)?, x.dtype(), x.device())?;
        let all = convolve(&normed, &kernel.unsqueeze(0)?, &none, 1)?
            .reshape((windows, length, 3, heads, width))?;
        let part = |part: usize| all.narrow(2, part, 1)?.squeeze(2)?.transpose(1, 2)?.contiguous();
        let (queries, keys, values) = (part(0)?, part(1)?, part(2)?); // [B, heads, L, width]
        let powers = keys.broadcast_sub(&keys.max_keepdim(2)?.detach())?.exp()?;
        let keys = powers.broadcast_div(&powers.sum_keepdim(2)?)?;
        let gathered = keys.transpose(2, 3)?.contiguous()?.matmul(&values)?; // [B, heads, width, width]
        let read = (queries.matmul(&gathered)? * (width as f64).powf(-0.5))?;
        let read = read.transpose(1, 2)?.reshape((windows, length, heads * width))?;
        x + self.linear(&format!("{name}.out"), &read)?
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gradients::finite_differences::{check_gradients, random};

    /// Two heads read what keys gather; the gradient is that of differences, of weights and of what
    /// goes in.
    #[test]
    fn attention_has_the_gradient_of_finite_differences() {
        let attention = Some(Attention { heads: 2, width: 3 });
        let config = TrajectoryConfig {
            horizon: 4,
            channels: 4,
            multipliers: vec![1],
            groups: 1,
            attention,
        };
        let names = ["a.scale", "a.shift", "a.queries.kernel", "a.out.kernel", "a.out.bias"];
        let arguments = [
            random((2, 4, 4), 0),
            random(4, 1),
            random(4, 2),
            random((4, 18), 3),
            random((6, 4), 4),
            random(4, 5),
        ];
        check_gradients(&arguments, |x| {
            let tensors =
                names.iter().zip(&x[1..]).map(|(name, x)| (name.to_string(), x.clone())).collect();
            Layers { tensors, config: &config }.attend("a", &x[0])
        });
    }
}
