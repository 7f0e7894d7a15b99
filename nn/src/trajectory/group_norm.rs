//! Group norm over groups of channels and all steps of a window (Wu and He 2018), followed by Mish:
//! one operation of candle's on the CPU, which computes the statistics again on the backward pass;
//! plain ones elsewhere.

use crate::layers::plain::mish;
use crate::slices::{has_fast_implementation, read, slice};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use quad_kernels::activation::{Activation, activate, activate_with_slope};
use rayon::prelude::*;

/// Added to the variance, as in PyTorch.
const EPSILON: f32 = 1e-5;

/// Mish((x − mean)/√(variance + ε)·scale + shift), for `x [B, L, C]` and `[C]`, with the moments of
/// each window and each of the `groups` of consecutive channels, whose number divides C.
/// Differentiable in all three.
pub(crate) fn normed_mish(
    x: &Tensor,
    scale: &Tensor,
    shift: &Tensor,
    groups: usize,
) -> Result<Tensor> {
    let (windows, length, channels) = x.dims3()?;
    if has_fast_implementation(x.device()) {
        let operation = NormedMish { groups, channels, length };
        return x.contiguous()?.apply_op3(&scale.contiguous()?, &shift.contiguous()?, operation);
    }
    let grouped = x.reshape((windows, length, groups, channels / groups))?;
    let centered = grouped.broadcast_sub(&grouped.mean_keepdim((1, 3))?)?;
    let deviation = (centered.sqr()?.mean_keepdim((1, 3))? + f64::from(EPSILON))?.sqrt()?;
    let normed = centered.broadcast_div(&deviation)?.reshape((windows, length, channels))?;
    mish(&normed.broadcast_mul(scale)?.broadcast_add(shift)?)
}

/// The operation of (windows, scale, shift).
struct NormedMish {
    groups: usize,
    channels: usize,
    length: usize,
}

/// Adds the rows of `x`, each through `f` with the row of `y`, to `sums`.
fn add_rows(sums: &mut [f32], x: &[f32], y: &[f32], f: impl Fn(f32, f32) -> f32) {
    for (x, y) in x.chunks_exact(sums.len()).zip(y.chunks_exact(sums.len())) {
        sums.iter_mut().zip(x.iter().zip(y)).for_each(|(sum, (x, y))| *sum += f(*x, *y));
    }
}

impl NormedMish {
    /// Numbers in a window.
    fn size(&self) -> usize {
        self.length * self.channels
    }

    /// Sums of channels → the mean of each channel's group over all steps, in place.
    fn spread(&self, sums: &mut [f32]) {
        let wide = self.channels / self.groups;
        let share = 1.0 / (self.length * wide) as f32;
        for group in sums.chunks_exact_mut(wide) {
            let mean = group.iter().sum::<f32>() * share;
            group.fill(mean);
        }
    }

    /// Writes a window's normed numbers. Gives 1/√(variance + ε) of each channel.
    fn norm(&self, x: &[f32], out: &mut [f32]) -> Vec<f32> {
        let mut mean = vec![0.0; self.channels];
        add_rows(&mut mean, x, x, |x, _| x);
        self.spread(&mut mean);
        for (x, out) in x.chunks_exact(self.channels).zip(out.chunks_exact_mut(self.channels)) {
            out.iter_mut().zip(x.iter().zip(&mean)).for_each(|(out, (x, mean))| *out = x - mean);
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

    /// The gradients of a window's numbers, and of scale and shift, `[2, C]`, by this window.
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
        // Before the activation.
        out.iter_mut()
            .zip(gradient.iter().zip(&slope))
            .for_each(|(out, (g, slope))| *out = g * slope);
        let (of_scale, of_shift) = sums.split_at_mut(self.channels);
        add_rows(of_scale, out, &normed, |delta, x| delta * x);
        add_rows(of_shift, out, &normed, |delta, _| delta);
        // Before scale and shift; then through the moments.
        let mut along: Vec<f32> =
            of_scale.iter().zip(scale).map(|(sum, scale)| sum * scale).collect();
        let mut mean: Vec<f32> =
            of_shift.iter().zip(scale).map(|(sum, scale)| sum * scale).collect();
        self.spread(&mut along);
        self.spread(&mut mean);
        for (out, normed) in
            out.chunks_exact_mut(self.channels).zip(normed.chunks_exact(self.channels))
        {
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
        let out = self.forward(
            slice(x, x_layout)?,
            slice(scale, scale_layout)?,
            slice(shift, shift_layout)?,
        );
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
        let gradient = gradient.contiguous()?;
        let (scales, shifts) = (scale.to_vec1::<f32>()?, shift.to_vec1::<f32>()?);
        let mut out = vec![0.0; x.elem_count()];
        let mut sums = vec![0.0; x.elem_count() / self.size() * 2 * self.channels];
        read(x, |x: &[f32]| {
            read(&gradient, |gradient: &[f32]| {
                let windows =
                    out.par_chunks_mut(self.size()).zip(sums.par_chunks_mut(2 * self.channels));
                let given = x.par_chunks(self.size()).zip(gradient.par_chunks(self.size()));
                windows.zip(given).for_each(|((out, sums), (x, gradient))| {
                    self.backward(x, [&scales, &shifts], gradient, out, sums);
                });
            })
        })??;
        let mut both = vec![0.0; 2 * self.channels];
        add_rows(&mut both, &sums, &sums, |x, _| x);
        let of_shift = both.split_off(self.channels);
        let tensor = |numbers: Vec<f32>, of: &Tensor| {
            Tensor::from_vec(numbers, of.shape(), of.device()).map(Some)
        };
        Ok((tensor(out, x)?, tensor(both, scale)?, tensor(of_shift, shift)?))
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gradients::finite_differences::{check_gradients, random};
    use crate::slices::plainly;

    #[test]
    fn one_operation_gives_what_plain_ones_give() {
        let (x, scale, shift) = (random((3, 5, 12), 0), random(12, 1), random(12, 2));
        for groups in [1, 3, 12] {
            let [fast, plain] = [
                normed_mish(&x, &scale, &shift, groups).unwrap(),
                plainly(|| normed_mish(&x, &scale, &shift, groups)).unwrap(),
            ];
            let difference = (fast - plain).unwrap().abs().unwrap().max_all().unwrap();
            assert!(difference.to_scalar::<f32>().unwrap() < 1e-5, "{groups} groups");
        }
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        let arguments = [random((2, 3, 4), 3), random(4, 4), random(4, 5)];
        let of = |x: &[Tensor]| normed_mish(&x[0], &x[1], &x[2], 2);
        check_gradients(&arguments, of);
        plainly(|| check_gradients(&arguments, of));
    }
}
