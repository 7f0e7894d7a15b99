//! Noise schedules and one step of the reverse process.

use candle_core::{Device, Result, Tensor};
use serde::{Deserialize, Serialize};
use std::iter::repeat_n;

/// Formula of a reverse step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reverse {
    /// x_0 is clipped to ±1, the variance is 1 − α_t (DAC).
    #[default]
    ClipClean,
    /// x_0 is clipped to ±1, the variance is the posterior's, (1 − α_t)(1 − ᾱ_{t−1})/(1 − ᾱ_t)
    /// (Diffusion-QL).
    Posterior,
    /// x_{t−1} is clipped instead, after adding noise; the variance is 1 − α_t (IDQL, AlignIQL).
    ClipSample,
    /// As `Posterior`, on the cosine schedule (Diffusion Policy).
    Cosine,
}

/// Constants of the diffusion over t = 1..T (Eq. 3–5).
#[derive(Clone, Debug, PartialEq)]
pub struct Schedule {
    steps: Vec<Step>,
    reverse: Reverse,
}

/// Coefficients at one t.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Step {
    /// √ᾱ_t.
    signal: f32,
    /// √(1 − ᾱ_t).
    deviation: f32,
    /// Factor of x_0 in the posterior's mean.
    from_clean: f32,
    /// Factor of x_t in the posterior's mean.
    from_noisy: f32,
    /// Standard deviation of the noise, 0 at t = 1.
    noise: f32,
}

impl Schedule {
    /// The schedule of T steps that goes with a formula. [`Reverse::Cosine`] has ᾱ_t = f(t/T)/f(0)
    /// with f(x) = cos²(π/2·(x + 0.008)/1.008), each β_t at most 0.999 (Nichol and Dhariwal 2021);
    /// the others have DAC's "vp": β_t = 1 − exp(−0.1/T − 0.5·(10 − 0.1)·(2t − 1)/T²).
    pub fn new(steps: usize, reverse: Reverse) -> Self {
        let total = steps as f64;
        let f = |t: usize| {
            ((t as f64 / total + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2)
        };
        let alpha = |t: usize| match reverse {
            Reverse::Cosine => (f(t) / f(t - 1)).max(0.001),
            _ => (-0.1 / total - 0.5 * (10.0 - 0.1) * (2 * t - 1) as f64 / (total * total)).exp(),
        };
        let mut before = 1.0; // ᾱ_{t-1}
        let step = |t: usize| {
            let alpha = alpha(t);
            let alpha_bar = before * alpha;
            let posterior = match reverse {
                Reverse::Posterior | Reverse::Cosine => (1.0 - before) / (1.0 - alpha_bar),
                Reverse::ClipClean | Reverse::ClipSample => 1.0,
            };
            let step = Step {
                signal: alpha_bar.sqrt() as f32,
                deviation: (1.0 - alpha_bar).sqrt() as f32,
                from_clean: (before.sqrt() * (1.0 - alpha) / (1.0 - alpha_bar)) as f32,
                from_noisy: (alpha.sqrt() * (1.0 - before) / (1.0 - alpha_bar)) as f32,
                noise: match t {
                    1 => 0.0,
                    _ => ((1.0 - alpha) * posterior).sqrt() as f32,
                },
            };
            before = alpha_bar;
            step
        };
        let steps = (1..=steps).map(step).collect();
        Self { steps, reverse }
    }

    /// The variance of the noise of a reverse step, 0 at t = 1.
    pub fn variance(&self, t: usize) -> f32 {
        self.steps[t - 1].noise.powi(2)
    }

    /// √(1 − ᾱ_t).
    pub fn deviation(&self, t: usize) -> f32 {
        self.steps[t - 1].deviation
    }

    /// x_t → x_{t−1}, given the predicted x_0: the posterior's mean, plus noise `z` for t > 1. All of
    /// one shape.
    pub fn reverse_to_clean(
        &self,
        t: usize,
        x: &Tensor,
        clean: &Tensor,
        z: Option<&Tensor>,
    ) -> Result<Tensor> {
        let step = self.steps[t - 1];
        let mean = ((clean * f64::from(step.from_clean))? + (x * f64::from(step.from_noisy))?)?;
        match z {
            Some(z) if t > 1 => mean + (z * f64::from(step.noise))?,
            _ => Ok(mean),
        }
    }

    /// √ᾱ_t and √(1 − ᾱ_t) for each t in 1..=T, repeated in all columns, `[B, width]` each; the second
    /// is also the guidance weight w(t).
    pub fn noising(&self, t: &[u32], width: usize, device: &Device) -> Result<(Tensor, Tensor)> {
        let rows = |number: fn(&Step) -> f32| {
            let row = |t: &u32| repeat_n(number(&self.steps[*t as usize - 1]), width);
            Tensor::from_vec(t.iter().flat_map(row).collect(), (t.len(), width), device)
        };
        Ok((rows(|step| step.signal)?, rows(|step| step.deviation)?))
    }

    /// x_0 = (x_t − √(1 − ᾱ_t)·ε)/√ᾱ_t for a predicted noise ε, clipped to ±1 unless samples are; all
    /// `[rows, a]`. Multiplies by 1/√ᾱ_t as the samplers on slices and GPUs do, which it is to match.
    pub fn clean(&self, t: usize, x: &Tensor, epsilon: &Tensor) -> Result<Tensor> {
        let step = self.steps[t - 1];
        let clean = ((x - (epsilon * f64::from(step.deviation))?)? * f64::from(1.0 / step.signal))?;
        match self.reverse {
            Reverse::ClipSample => Ok(clean),
            _ => clean.clamp(-1f32, 1f32),
        }
    }

    /// x_t → x_{t−1}: the posterior's mean, plus noise for t > 1. `epsilon` is the predicted noise,
    /// `z` standard normal; all `[rows, a]`, and differentiable.
    pub fn reverse(
        &self,
        t: usize,
        x: &Tensor,
        epsilon: &Tensor,
        z: Option<&Tensor>,
    ) -> Result<Tensor> {
        let next = self.reverse_to_clean(t, x, &self.clean(t, x, epsilon)?, z)?;
        match self.reverse {
            Reverse::ClipSample => next.clamp(-1f32, 1f32),
            _ => Ok(next),
        }
    }

    /// The coefficients of the reverse steps of t = 1..T as a GPU takes them
    /// (`quad_kernels::cuda_mlp`), seven each.
    #[cfg(feature = "cuda")]
    pub(crate) fn reverse_steps(&self) -> Vec<f32> {
        let (clean, sample) = self.bounds();
        let coefficients = |step: &Step| {
            let means = [step.from_clean, step.from_noisy, step.noise];
            [&[step.deviation, 1.0 / step.signal, clean][..], &means, &[sample]].concat()
        };
        self.steps.iter().flat_map(coefficients).collect()
    }

    /// Bounds of the predicted x_0 and of x_{t−1}.
    fn bounds(&self) -> (f32, f32) {
        match self.reverse {
            Reverse::ClipSample => (f32::INFINITY, 1.0),
            _ => (1.0, f32::INFINITY),
        }
    }

    /// [`Self::reverse`] on slices; `z` is not read at t = 1.
    pub(crate) fn reverse_in_place(&self, t: usize, x: &mut [f32], epsilon: &[f32], z: &[f32]) {
        let (step, (clean_bound, bound)) = (self.steps[t - 1], self.bounds());
        let scale = 1.0 / step.signal;
        for (i, (x, epsilon)) in x.iter_mut().zip(epsilon).enumerate() {
            let clean = ((*x - step.deviation * epsilon) * scale).clamp(-clean_bound, clean_bound);
            let mean = step.from_clean * clean + step.from_noisy * *x;
            let next = match t {
                1 => mean,
                _ => mean + step.noise * z[i],
            };
            *x = next.clamp(-bound, bound);
        }
    }
}
