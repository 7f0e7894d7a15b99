//! Group norm over groups of channels and all steps of a trajectory (Wu and He 2018), then Mish. One
//! operation of candle's on the CPU, which recomputes the statistics in the backward pass and with
//! which a step of Diffuser takes half the time; plain operations elsewhere.

use crate::layers::plain::mish;
use crate::slices::{has_fast_implementation, read_all, slice};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use quad_kernels::activation::{Activation, activate, activate_with_slope};
use rayon::prelude::*;

/// Number added to the variance, as in PyTorch.
const EPSILON: f32 = 1e-5;

/// Mish((x − mean)/√(variance + ε)·scale + shift) for `x [B, L, C]`, scale and shift `[C]`, with the
/// moments of each trajectory and each group of consecutive channels. Differentiable in all three.
pub(crate) fn normed_mish(
    x: &Tensor,
    scale: &Tensor,
    shift: &Tensor,
    groups: usize,
) -> Result<Tensor> {
    let (batch, length, channels) = x.dims3()?;
    if has_fast_implementation(x.device()) {
        let operation = NormedMish { groups, channels, length };
        let (scale, shift) = (scale.contiguous()?, shift.contiguous()?);
        return x.contiguous()?.apply_op3(&scale, &shift, operation);
    }
    let grouped = x.reshape((batch, length, groups, channels / groups))?;
    let centered = grouped.broadcast_sub(&grouped.mean_keepdim((1, 3))?)?;
    let deviation = (centered.sqr()?.mean_keepdim((1, 3))? + f64::from(EPSILON))?.sqrt()?;
    let normed = centered.broadcast_div(&deviation)?.reshape((batch, length, channels))?;
    mish(&normed.broadcast_mul(scale)?.broadcast_add(shift)?)
}

/// The operation of (x, scale, shift).
struct NormedMish {
    groups: usize,
    channels: usize,
    length: usize,
}

/// Adds f(x, y) of all rows to `sums`.
fn add_rows(sums: &mut [f32], x: &[f32], y: &[f32], f: impl Fn(f32, f32) -> f32) {
    for (x, y) in x.chunks_exact(sums.len()).zip(y.chunks_exact(sums.len())) {
        sums.iter_mut().zip(x.iter().zip(y)).for_each(|(sum, (x, y))| *sum += f(*x, *y));
    }
}

impl NormedMish {
    /// Numbers in a trajectory.
    fn size(&self) -> usize {
        self.length * self.channels
    }

    /// Replaces the sums of channels by the mean of each channel's group.
    fn spread(&self, sums: &mut [f32]) {
        let wide = self.channels / self.groups;
        let share = 1.0 / (self.length * wide) as f32;
        for group in sums.chunks_exact_mut(wide) {
            let mean = group.iter().sum::<f32>() * share;
            group.fill(mean);
        }
    }

    /// Normalizes a trajectory. Returns 1/√(variance + ε) of each channel.
    fn norm(&self, x: &[f32], out: &mut [f32]) -> Vec<f32> {
        let mut mean = vec![0.0; self.channels];
        add_rows(&mut mean, x, x, |x, _| x);
        self.spread(&mut mean);
        let rows = x.chunks_exact(self.channels);
        for (x, out) in rows.zip(out.chunks_exact_mut(self.channels)) {
            for (out, (x, mean)) in out.iter_mut().zip(x.iter().zip(&mean)) {
                *out = x - mean;
            }
        }
        let mut inverse = vec![0.0; self.channels];
        add_rows(&mut inverse, out, out, |x, y| x * y);
        self.spread(&mut inverse);
        inverse.iter_mut().for_each(|x| *x = 1.0 / (*x + EPSILON).sqrt());
        scale_rows(out, &inverse);
        inverse
    }

    fn forward(&self, x: &[f32], scale: &[f32], shift: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; x.len()];
        out.par_chunks_mut(self.size()).zip(x.par_chunks(self.size())).for_each(|(out, x)| {
            self.norm(x, out);
            scale_rows(out, scale);
            activate(Activation::Mish, out, shift);
        });
        out
    }

    /// The gradient of a trajectory, and its part of those of scale and shift, `2 × C`.
    fn backward(
        &self,
        x: &[f32],
        [scale, shift]: [&[f32]; 2],
        gradient: &[f32],
        out: &mut [f32],
        sums: &mut [f32],
    ) {
        let (mut normed, mut slope) = (vec![0.0; x.len()], vec![0.0; x.len()]);
        let inverse = self.norm(x, &mut normed);
        out.copy_from_slice(&normed);
        scale_rows(out, scale);
        activate_with_slope(Activation::Mish, out, shift, &mut slope);
        // The gradient before the activation.
        for (out, (g, slope)) in out.iter_mut().zip(gradient.iter().zip(&slope)) {
            *out = g * slope;
        }
        let (scale_gradient, shift_gradient) = sums.split_at_mut(self.channels);
        add_rows(scale_gradient, out, &normed, |delta, x| delta * x);
        add_rows(shift_gradient, out, &normed, |delta, _| delta);
        // The gradient before scale and shift, then through the moments.
        let scaled_mean = |sums: &[f32]| {
            let mut scaled = sums.to_vec();
            scale_rows(&mut scaled, scale);
            self.spread(&mut scaled);
            scaled
        };
        let [along, mean] = [&*scale_gradient, shift_gradient].map(scaled_mean);
        let rows = normed.chunks_exact(self.channels);
        for (out, normed) in out.chunks_exact_mut(self.channels).zip(rows) {
            for (i, (out, x)) in out.iter_mut().zip(normed).enumerate() {
                *out = (*out * scale[i] - mean[i] - x * along[i]) * inverse[i];
            }
        }
    }
}

/// Multiplies each row of `x` by `factors`.
fn scale_rows(x: &mut [f32], factors: &[f32]) {
    for row in x.chunks_exact_mut(factors.len()) {
        row.iter_mut().zip(factors).for_each(|(x, factor)| *x *= factor);
    }
}

impl CustomOp3 for NormedMish {
    fn name(&self) -> &'static str {
        "group-norm-and-mish"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        scale: &CpuStorage,
        scale_layout: &Layout,
        shift: &CpuStorage,
        shift_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (scale, shift) = (slice(scale, scale_layout)?, slice(shift, shift_layout)?);
        let out = self.forward(slice(x, x_layout)?, scale, shift);
        Ok((CpuStorage::F32(out), x_layout.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        scale: &Tensor,
        shift: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let mut out = vec![0.0; x.elem_count()];
        let mut sums = vec![0.0; x.elem_count() / self.size() * 2 * self.channels];
        let arguments = [x, scale, shift, &gradient.contiguous()?];
        read_all(arguments, |[x, scale, shift, gradient]| {
            let sums = sums.par_chunks_mut(2 * self.channels);
            let results = out.par_chunks_mut(self.size()).zip(sums);
            let given = x.par_chunks(self.size()).zip(gradient.par_chunks(self.size()));
            results.zip(given).for_each(|((out, sums), (x, gradient))| {
                self.backward(x, [scale, shift], gradient, out, sums);
            });
        })?;
        let mut both = vec![0.0; 2 * self.channels];
        add_rows(&mut both, &sums, &sums, |x, _| x);
        let shift_gradient = both.split_off(self.channels);
        let tensor = |numbers: Vec<f32>, argument: &Tensor| {
            Tensor::from_vec(numbers, argument.shape(), x.device()).map(Some)
        };
        let scale_gradient = tensor(both, scale)?;
        Ok((tensor(out, x)?, scale_gradient, tensor(shift_gradient, shift)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{check_operation, random};

    #[test]
    fn group_norm_matches_the_plain_one_and_finite_differences() -> Result<()> {
        let arguments = [random((3, 5, 12), 0), random(12, 1), random(12, 2)];
        for groups in [1, 3, 12] {
            let normed = |x: &[Tensor]| normed_mish(&x[0], &x[1], &x[2], groups);
            check_operation("group norm", &arguments, normed)?;
        }
        Ok(())
    }
}
