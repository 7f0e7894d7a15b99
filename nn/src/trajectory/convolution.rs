//! Convolutions along the steps of trajectories `[B, L, C]`, as products of unfolded trajectories
//! ("im2col"). One operation of candle's on the CPU, with which a step of Diffuser takes 0.75 of the
//! time; plain operations elsewhere.

use crate::slices::{has_fast_implementation, read_all, slice};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use quad_kernels::Precision::F32;
use quad_kernels::activation::column_sums;
use quad_kernels::product::{outer, product, product_transposed};
use rayon::prelude::*;

/// Rows of unfolded trajectories in one task.
const ROWS: usize = 128;

/// `x [B, L, C]`, `kernel [taps, C, C']`, `bias [C']` → `[B, L', C']` with zero padding, so that
/// L' = ⌈L / stride⌉. `taps` is odd. Differentiable in all three.
pub(crate) fn convolve(
    x: &Tensor,
    kernel: &Tensor,
    bias: &Tensor,
    stride: usize,
) -> Result<Tensor> {
    let ((batch, length, inputs), (taps, _, outputs)) = (x.dims3()?, kernel.dims3()?);
    let shape = Convolution { taps, stride, length, inputs, outputs };
    let x = x.contiguous()?;
    if has_fast_implementation(x.device()) {
        return x.apply_op3(&kernel.contiguous()?, &bias.contiguous()?, shape);
    }
    let step_places = |step| (0..taps).map(move |tap| (step * stride + tap) as u32);
    let places = Tensor::from_iter((0..shape.steps()).flat_map(step_places), x.device())?;
    let rows = (batch * shape.steps(), taps * inputs);
    let padded = x.pad_with_zeros(1, taps / 2, taps / 2)?;
    let unfolded = padded.index_select(&places, 1)?.reshape(rows)?;
    let out = unfolded.matmul(&kernel.reshape((taps * inputs, outputs))?)?;
    out.broadcast_add(bias)?.reshape((batch, shape.steps(), outputs))
}

/// The transposed convolution with four taps and stride 2: `x [B, L, C]`, `kernel [C, 4, C']`,
/// `bias [C']` → `[B, 2L, C']`. Tap j of step i adds to step 2i + j − 1.
pub(crate) fn double(x: &Tensor, kernel: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let ((batch, length, _), (inputs, taps, outputs)) = (x.dims3()?, kernel.dims3()?);
    let none = bias.zeros_like()?;
    // Each step gets the bias once: even steps with tap 1, odd ones with tap 2.
    let biases = Tensor::cat(&[&none, bias, bias, &none], 0)?;
    let products = convolve(x, &kernel.reshape((1, inputs, taps * outputs))?, &biases, 1)?;
    let tap = |tap: usize| products.narrow(2, tap * outputs, outputs);
    let even = (tap(1)? + tap(3)?.pad_with_zeros(1, 1, 0)?.narrow(1, 0, length)?)?;
    let odd = (tap(2)? + tap(0)?.pad_with_zeros(1, 0, 1)?.narrow(1, 1, length)?)?;
    Tensor::stack(&[even, odd], 2)?.reshape((batch, 2 * length, outputs))
}

/// The operation of (x, kernel, bias).
#[derive(Clone, Copy)]
struct Convolution {
    taps: usize,
    stride: usize,
    /// L, C and C'.
    length: usize,
    inputs: usize,
    outputs: usize,
}

impl Convolution {
    /// L'.
    fn steps(&self) -> usize {
        self.length.div_ceil(self.stride)
    }

    /// Trajectories of a tile.
    fn tile(&self) -> usize {
        (ROWS / self.steps()).max(1)
    }

    /// Calls `work` with each step of the result, each of these taps, and the step of x that the tap
    /// reads, or `None` in the padding.
    fn places(
        &self,
        taps: std::ops::Range<usize>,
        mut work: impl FnMut(usize, usize, Option<usize>),
    ) {
        for step in 0..self.steps() {
            for tap in taps.clone() {
                let place = (step * self.stride + tap).checked_sub(self.taps / 2);
                work(step, tap, place.filter(|place| *place < self.length));
            }
        }
    }

    /// `n × L × C` → `n × L' × (taps·C)` for these taps.
    fn unfold(&self, x: &[f32], taps: std::ops::Range<usize>) -> Vec<f32> {
        let (c, width) = (self.inputs, taps.len() * self.inputs);
        let mut out = Vec::with_capacity(x.len() / self.length / c * self.steps() * width);
        for trajectory in x.chunks_exact(self.length * c) {
            self.places(taps.clone(), |_, _, place| match place {
                Some(place) => out.extend_from_slice(&trajectory[place * c..][..c]),
                None => out.resize(out.len() + c, 0.0),
            });
        }
        out
    }

    /// The gradient of [`Self::unfold`], added to `x`.
    fn fold(&self, unfolded: &[f32], x: &mut [f32]) {
        let (c, width) = (self.inputs, self.taps * self.inputs);
        let rows = unfolded.chunks_exact(self.steps() * width);
        for (trajectory, rows) in x.chunks_exact_mut(self.length * c).zip(rows) {
            self.places(0..self.taps, |step, tap, place| {
                if let Some(place) = place {
                    let from = &rows[step * width + tap * c..][..c];
                    let to = trajectory[place * c..][..c].iter_mut();
                    to.zip(from).for_each(|(sum, x)| *sum += x);
                }
            });
        }
    }

    fn forward(&self, x: &[f32], kernel: &[f32], bias: &[f32]) -> Vec<f32> {
        let (tile, width, outputs) = (self.tile(), self.taps * self.inputs, self.outputs);
        let size = self.length * self.inputs;
        let mut out = vec![0.0; x.len() / size * self.steps() * outputs];
        let tiles = out.par_chunks_mut(tile * self.steps() * outputs);
        tiles.zip(x.par_chunks(tile * size)).for_each(|(out, x)| {
            match self.taps {
                1 => product(F32, x, kernel, out, width, outputs),
                taps => product(F32, &self.unfold(x, 0..taps), kernel, out, width, outputs),
            }
            for row in out.chunks_exact_mut(outputs) {
                row.iter_mut().zip(bias).for_each(|(x, b)| *x += b);
            }
        });
        out
    }

    fn input_gradient(&self, kernel: &[f32], gradient: &[f32]) -> Vec<f32> {
        let (tile, width, outputs) = (self.tile(), self.taps * self.inputs, self.outputs);
        let rows = gradient.len() / outputs;
        let mut out = vec![0.0; rows / self.steps() * self.length * self.inputs];
        let tiles = out.par_chunks_mut(tile * self.length * self.inputs);
        let gradients = gradient.par_chunks(tile * self.steps() * outputs);
        tiles.zip(gradients).for_each(|(out, gradient)| {
            if self.taps == 1 {
                return product_transposed(F32, gradient, kernel, out, width, outputs);
            }
            let mut unfolded = vec![0.0; gradient.len() / outputs * width];
            product_transposed(F32, gradient, kernel, &mut unfolded, width, outputs);
            self.fold(&unfolded, out);
        });
        out
    }

    fn kernel_gradient(&self, x: &[f32], gradient: &[f32]) -> Vec<f32> {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let mut out = vec![0.0; self.taps * inputs * outputs];
        let kernels = out.par_chunks_mut(inputs * outputs).enumerate();
        kernels.for_each(|(tap, out)| match self.taps {
            1 => outer(F32, x, gradient, out, inputs, outputs),
            _ => {
                let x = self.unfold(x, tap..tap + 1);
                outer(F32, &x, gradient, out, inputs, outputs);
            }
        });
        out
    }
}

impl CustomOp3 for Convolution {
    fn name(&self) -> &'static str {
        "convolution"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        kernel: &CpuStorage,
        kernel_layout: &Layout,
        bias: &CpuStorage,
        bias_layout: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (kernel, bias) = (slice(kernel, kernel_layout)?, slice(bias, bias_layout)?);
        let out = self.forward(slice(x, x_layout)?, kernel, bias);
        let shape = (x_layout.dims()[0], self.steps(), self.outputs);
        Ok((CpuStorage::F32(out), shape.into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        kernel: &Tensor,
        bias: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (gradient, device) = (gradient.contiguous()?, gradient.device());
        read_all([x, kernel, &gradient], |[x_numbers, kernel_numbers, g]| {
            let tensor = |argument: &Tensor, gradient: &dyn Fn() -> Vec<f32>| {
                let gradient = argument.track_op().then(gradient);
                let tensor = |numbers| Tensor::from_vec(numbers, argument.shape(), device);
                gradient.map(tensor).transpose()
            };
            let x_gradient = tensor(x, &|| self.input_gradient(kernel_numbers, g))?;
            let kernel_gradient = tensor(kernel, &|| self.kernel_gradient(x_numbers, g))?;
            let bias_gradient = tensor(bias, &|| {
                let mut sums = vec![0.0; self.outputs];
                column_sums(g, &mut sums);
                sums
            })?;
            Ok((x_gradient, kernel_gradient, bias_gradient))
        })?
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{assert_close, check_gradients, check_operation, random};

    /// The golden test of Diffuser compares both with a definition.
    #[test]
    fn a_convolution_matches_the_plain_one_and_finite_differences() -> Result<()> {
        for (length, taps, stride) in [(6, 5, 1), (1, 5, 1), (5, 3, 2), (6, 3, 2), (3, 1, 1)] {
            let (x, kernel) = (random((2, length, 3), 6), random((taps, 3, 2), 7));
            let arguments = [x, kernel, random(2, 8)];
            let convolved = |x: &[Tensor]| convolve(&x[0], &x[1], &x[2], stride);
            check_operation("convolution", &arguments, convolved)?;
        }
        Ok(())
    }

    #[test]
    fn doubling_matches_its_definition_and_finite_differences() -> Result<()> {
        let arguments = [random((2, 3, 3), 9), random((3, 4, 2), 10), random(2, 11)];
        let doubled = |x: &[Tensor]| double(&x[0], &x[1], &x[2]);
        check_gradients("doubling", &arguments, doubled)?;
        // Tap j of step 1 alone adds to step 1 + j.
        let [x, kernel, bias] = &arguments;
        let one = Tensor::new(&[0f32, 1.0, 0.0], x.device())?.reshape((1, 3, 1))?;
        let step = x.narrow(1, 1, 1)?.reshape((2, 3))?;
        let products = step.matmul(&kernel.reshape((3, 8))?)?.reshape((2, 4, 2))?;
        let expected = products.pad_with_zeros(1, 1, 1)?.broadcast_add(bias)?;
        let doubled = double(&x.broadcast_mul(&one)?, kernel, bias)?;
        assert_close("doubling", &doubled, &expected);
        Ok(())
    }
}
