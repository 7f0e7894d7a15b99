//! The layers of Diffuser's networks over trajectories `[B, L, C]`, by the names of their tensors
//! ([`LayoutBuilder`](crate::trajectory::config::LayoutBuilder)).

use crate::layers::plain::{layer_norm, mish, named};
use crate::trajectory::config::{Attention, TrajectoryConfig};
use crate::trajectory::convolution::{convolve, double};
use crate::trajectory::group_norm::normed_mish;
use crate::weights::{Tensors, Weights};
use candle_core::{Device, Result, Tensor};

/// Number added to the variance of attention's layer norm.
const EPSILON: f64 = 1e-5;

pub(crate) struct Layers<'a> {
    tensors: Tensors,
    config: &'a TrajectoryConfig,
}

/// Embeddings of the denoising steps, `[B, 1, embedding]`.
pub(crate) struct Time {
    pub embedding: Tensor,
    /// Mish of the embedding.
    activated: Tensor,
}

impl<'a> Layers<'a> {
    pub fn new(weights: &Weights, config: &'a TrajectoryConfig) -> Result<Self> {
        Ok(Self { tensors: weights.differentiable()?, config })
    }

    fn get(&self, name: &str, kind: &str) -> Result<&Tensor> {
        named(&self.tensors, format!("{name}.{kind}"))
    }

    /// The embedding of each t in 1..=T: sines, then cosines, of (t − 1)·f_k with f_k from 1 down to
    /// 10⁻⁴, through two layers.
    pub fn time(&self, t: &[u32], device: &Device) -> Result<Time> {
        let half = self.config.channels / 2;
        let angle = |t: u32, k: usize| {
            f64::from(t - 1) * (-(k as f64) * 10_000_f64.ln() / (half - 1) as f64).exp()
        };
        let mut features = Vec::with_capacity(t.len() * 2 * half);
        for t in t {
            for wave in [f64::sin, f64::cos] {
                features.extend((0..half).map(|k| wave(angle(*t, k)) as f32));
            }
        }
        let features = Tensor::from_vec(features, (t.len(), 1, 2 * half), device)?;
        let embedding = self.linear("time.1", &mish(&self.linear("time.0", &features)?)?)?;
        Ok(Time { activated: mish(&embedding)?, embedding })
    }

    /// x·kernel + bias of each step.
    pub fn linear(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let kernel = self.get(name, "kernel")?.unsqueeze(0)?;
        convolve(x, &kernel, self.get(name, "bias")?, 1)
    }

    fn norm(&self, name: &str) -> Result<(&Tensor, &Tensor)> {
        Ok((self.get(name, "scale")?, self.get(name, "shift")?))
    }

    /// A convolution, group norm, Mish.
    pub fn normed(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let x = convolve(x, self.get(name, "kernel")?, self.get(name, "bias")?, 1)?;
        let (scale, shift) = self.norm(name)?;
        normed_mish(&x, scale, shift, self.config.groups)
    }

    pub fn block(&self, name: &str, x: &Tensor, time: &Time) -> Result<Tensor> {
        let time = self.linear(&format!("{name}.time"), &time.activated)?;
        let inside = self.normed(&format!("{name}.0"), x)?.broadcast_add(&time)?;
        let inside = self.normed(&format!("{name}.1"), &inside)?;
        let skip = format!("{name}.skip");
        match self.tensors.contains_key(&format!("{skip}.kernel")) {
            true => inside + self.linear(&skip, x)?,
            false => inside + x,
        }
    }

    /// A convolution with stride 2.
    pub fn halve(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        convolve(x, self.get(name, "kernel")?, self.get(name, "bias")?, 2)
    }

    /// A transposed convolution with stride 2.
    pub fn double(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        double(x, self.get(name, "kernel")?, self.get(name, "bias")?)
    }

    /// x plus linear attention (Shen et al. 2021) of its layer norm, if configured: queries·softmax
    /// over steps of keysᵀ·values.
    pub fn attend(&self, name: &str, x: &Tensor) -> Result<Tensor> {
        let Some(Attention { heads, width }) = self.config.attention else { return Ok(x.clone()) };
        let (batch, length, _) = x.dims3()?;
        let (scale, shift) = self.norm(name)?;
        let normed = layer_norm(x, scale, shift, EPSILON)?;
        let kernel = self.get(name, "queries.kernel")?;
        let none = Tensor::zeros(kernel.dim(1)?, x.dtype(), x.device())?;
        let projected = convolve(&normed, &kernel.unsqueeze(0)?, &none, 1)?;
        let projected = projected.reshape((batch, length, 3, heads, width))?;
        let part = |part: usize| {
            let part = projected.narrow(2, part, 1)?.squeeze(2)?;
            part.transpose(1, 2)?.contiguous()
        };
        let (queries, keys, values) = (part(0)?, part(1)?, part(2)?); // [B, heads, L, width]
        let powers = keys.broadcast_sub(&keys.max_keepdim(2)?.detach())?.exp()?;
        let keys = powers.broadcast_div(&powers.sum_keepdim(2)?)?;
        let gathered = keys.transpose(2, 3)?.contiguous()?.matmul(&values)?; // [B, heads, width, width]
        let out = (queries.matmul(&gathered)? * (width as f64).powf(-0.5))?;
        let out = out.transpose(1, 2)?.reshape((batch, length, heads * width))?;
        x + self.linear(&format!("{name}.out"), &out)?
    }
}
