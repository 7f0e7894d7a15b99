//! Convolutions along the steps of windows `[B, L, C]`, each as a product of unfolded windows: a
//! row of the left side has the steps that a step of the result depends on. On the CPU one
//! operation of candle's, tile by tile; elsewhere plain ones.

use crate::slices::{has_fast_implementation, read, slice};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor};
use quad_kernels::activation::column_sums;
use quad_kernels::product::{outer, product, product_transposed};
use rayon::prelude::*;

/// Rows of unfolded windows that are worked on together.
const ROWS: usize = 128;

/// `x [B, L, C]`, `kernel [taps, C, C']`, `bias [C']` → `[B, L', C']`: every `stride`-th step, with
/// zeros before the first and after the last, so that L' = ⌈L / stride⌉. `taps` is odd.
/// Differentiable in all three.
pub(crate) fn convolve(
    x: &Tensor,
    kernel: &Tensor,
    bias: &Tensor,
    stride: usize,
) -> Result<Tensor> {
    let ((windows, length, inputs), (taps, _, outputs)) = (x.dims3()?, kernel.dims3()?);
    let shape = Convolution { taps, stride, length, inputs, outputs };
    let x = x.contiguous()?;
    if has_fast_implementation(x.device()) {
        return x.apply_op3(&kernel.contiguous()?, &bias.contiguous()?, shape);
    }
    let places =
        (0..shape.steps()).flat_map(|step| (0..taps).map(move |tap| (step * stride + tap) as u32));
    let places = Tensor::from_iter(places, x.device())?;
    let rows = (windows * shape.steps(), taps * inputs);
    let unfolded =
        x.pad_with_zeros(1, taps / 2, taps / 2)?.index_select(&places, 1)?.reshape(rows)?;
    let out = unfolded.matmul(&kernel.reshape((taps * inputs, outputs))?)?.broadcast_add(bias)?;
    out.reshape((windows, shape.steps(), outputs))
}

/// The transposed convolution of four taps and stride 2 that doubles the steps: `x [B, L, C]`,
/// `kernel [C, 4, C']`, `bias [C']` → `[B, 2L, C']`. Tap j of step i adds to step 2i + j − 1.
pub(crate) fn double(x: &Tensor, kernel: &Tensor, bias: &Tensor) -> Result<Tensor> {
    let ((windows, length, _), (inputs, taps, outputs)) = (x.dims3()?, kernel.dims3()?);
    let none = bias.zeros_like()?;
    // The bias comes once into each step: with tap 1 into even ones, with tap 2 into odd ones.
    let biases = Tensor::cat(&[&none, bias, bias, &none], 0)?;
    let products = convolve(x, &kernel.reshape((1, inputs, taps * outputs))?, &biases, 1)?;
    let tap = |tap: usize| products.narrow(2, tap * outputs, outputs);
    let even = (tap(1)? + tap(3)?.pad_with_zeros(1, 1, 0)?.narrow(1, 0, length)?)?;
    let odd = (tap(2)? + tap(0)?.pad_with_zeros(1, 0, 1)?.narrow(1, 1, length)?)?;
    Tensor::stack(&[even, odd], 2)?.reshape((windows, 2 * length, outputs))
}

/// The operation of (windows, kernel, bias).
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

    /// Windows of a tile.
    fn tile(&self) -> usize {
        (ROWS / self.steps()).max(1)
    }

    /// Calls `work` with each step of the result, each of these taps, and the step of the window
    /// that the tap reads, if it is within the window.
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

    /// Windows `n × L × C` → `n × L' × (taps · C)`, for these taps.
    fn unfold(&self, x: &[f32], taps: std::ops::Range<usize>) -> Vec<f32> {
        let (c, width) = (self.inputs, taps.len() * self.inputs);
        let mut out = Vec::with_capacity(x.len() / self.length / c * self.steps() * width);
        for window in x.chunks_exact(self.length * c) {
            self.places(taps.clone(), |_, _, place| match place {
                Some(place) => out.extend_from_slice(&window[place * c..][..c]),
                None => out.resize(out.len() + c, 0.0),
            });
        }
        out
    }

    /// Adds up what [`Self::unfold`] has copied, into zeros.
    fn fold(&self, unfolded: &[f32], x: &mut [f32]) {
        let (c, width) = (self.inputs, self.taps * self.inputs);
        for (window, rows) in
            x.chunks_exact_mut(self.length * c).zip(unfolded.chunks_exact(self.steps() * width))
        {
            self.places(0..self.taps, |step, tap, place| {
                if let Some(place) = place {
                    let from = &rows[step * width + tap * c..][..c];
                    window[place * c..][..c].iter_mut().zip(from).for_each(|(sum, x)| *sum += x);
                }
            });
        }
    }

    fn forward(&self, x: &[f32], kernel: &[f32], bias: &[f32]) -> Vec<f32> {
        let (tile, width) = (self.tile(), self.taps * self.inputs);
        let mut out =
            vec![0.0; x.len() / (self.length * self.inputs) * self.steps() * self.outputs];
        let tiles = out.par_chunks_mut(tile * self.steps() * self.outputs);
        tiles.zip(x.par_chunks(tile * self.length * self.inputs)).for_each(|(out, x)| {
            match self.taps {
                1 => product(x, kernel, out, width, self.outputs),
                _ => product(&self.unfold(x, 0..self.taps), kernel, out, width, self.outputs),
            }
            for row in out.chunks_exact_mut(self.outputs) {
                row.iter_mut().zip(bias).for_each(|(x, b)| *x += b);
            }
        });
        out
    }

    fn input_gradient(&self, kernel: &[f32], gradient: &[f32]) -> Vec<f32> {
        let (tile, width) = (self.tile(), self.taps * self.inputs);
        let rows = gradient.len() / self.outputs;
        let mut out = vec![0.0; rows / self.steps() * self.length * self.inputs];
        let tiles = out.par_chunks_mut(tile * self.length * self.inputs);
        tiles.zip(gradient.par_chunks(tile * self.steps() * self.outputs)).for_each(
            |(out, gradient)| {
                if self.taps == 1 {
                    return product_transposed(gradient, kernel, out, width, self.outputs);
                }
                let mut unfolded = vec![0.0; gradient.len() / self.outputs * width];
                product_transposed(gradient, kernel, &mut unfolded, width, self.outputs);
                self.fold(&unfolded, out);
            },
        );
        out
    }

    fn kernel_gradient(&self, x: &[f32], gradient: &[f32]) -> Vec<f32> {
        let (inputs, outputs) = (self.inputs, self.outputs);
        let mut out = vec![0.0; self.taps * inputs * outputs];
        out.par_chunks_mut(inputs * outputs).enumerate().for_each(|(tap, out)| match self.taps {
            1 => outer(x, gradient, out, inputs, outputs),
            _ => outer(&self.unfold(x, tap..tap + 1), gradient, out, inputs, outputs),
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
        let out = self.forward(
            slice(x, x_layout)?,
            slice(kernel, kernel_layout)?,
            slice(bias, bias_layout)?,
        );
        Ok((CpuStorage::F32(out), (x_layout.dims()[0], self.steps(), self.outputs).into()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        kernel: &Tensor,
        bias: &Tensor,
        _: &Tensor,
        gradient: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let gradient = gradient.contiguous()?;
        let tensor =
            |numbers: Vec<f32>, of: &Tensor| Tensor::from_vec(numbers, of.shape(), of.device());
        read(&gradient, |g: &[f32]| {
            let of_x = match x.track_op() {
                true => {
                    Some(tensor(read(kernel, |kernel: &[f32]| self.input_gradient(kernel, g))?, x)?)
                }
                false => None,
            };
            let of_kernel = match kernel.track_op() {
                true => Some(tensor(read(x, |x: &[f32]| self.kernel_gradient(x, g))?, kernel)?),
                false => None,
            };
            let of_bias = match bias.track_op() {
                true => {
                    let mut sums = vec![0.0; self.outputs];
                    column_sums(g, &mut sums);
                    Some(tensor(sums, bias)?)
                }
                false => None,
            };
            Ok((of_x, of_kernel, of_bias))
        })?
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use crate::gradients::finite_differences::{check_gradients, random};
    use crate::slices::plainly;

    /// The definition, number by number.
    fn by_hand(
        x: &[Vec<Vec<f32>>],
        kernel: &[Vec<Vec<f32>>],
        bias: &[f32],
        stride: usize,
    ) -> Vec<f32> {
        let (taps, length) = (kernel.len(), x[0].len());
        let mut out = Vec::new();
        for window in x {
            for step in (0..length).step_by(stride) {
                for (o, bias) in bias.iter().enumerate() {
                    let mut sum = *bias;
                    for (tap, kernel) in kernel.iter().enumerate() {
                        let place = (step + tap).wrapping_sub(taps / 2);
                        if let Some(x) = window.get(place) {
                            sum += x.iter().zip(kernel).map(|(x, row)| x * row[o]).sum::<f32>();
                        }
                    }
                    out.push(sum);
                }
            }
        }
        out
    }

    fn close(found: &Tensor, expected: &[f32]) {
        let found = found.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        assert_eq!(found.len(), expected.len());
        assert!(
            found.iter().zip(expected).all(|(x, y)| (x - y).abs() < 1e-5),
            "{found:?} {expected:?}"
        );
    }

    #[test]
    fn a_convolution_is_what_its_definition_says() {
        for (length, taps, stride) in
            [(7, 5, 1), (1, 5, 1), (6, 3, 2), (5, 3, 2), (1, 3, 2), (4, 1, 1)]
        {
            let (x, kernel, bias) =
                (random((3, length, 2), 0), random((taps, 2, 4), 1), random(4, 2));
            let numbers = |x: &Tensor| x.to_vec3::<f32>().unwrap();
            let expected =
                by_hand(&numbers(&x), &numbers(&kernel), &bias.to_vec1::<f32>().unwrap(), stride);
            close(&convolve(&x, &kernel, &bias, stride).unwrap(), &expected);
            close(&plainly(|| convolve(&x, &kernel, &bias, stride)).unwrap(), &expected);
        }
    }

    #[test]
    fn a_doubling_is_what_its_definition_says() {
        for length in [1, 2, 5] {
            let (x, kernel, bias) = (random((2, length, 3), 3), random((3, 4, 2), 4), random(2, 5));
            let (rows, kernels, biases) = (
                x.to_vec3::<f32>().unwrap(),
                kernel.to_vec3::<f32>().unwrap(),
                bias.to_vec1::<f32>().unwrap(),
            );
            let mut expected = biases.repeat(2 * 2 * length);
            for (b, window) in rows.iter().enumerate() {
                for (i, row) in window.iter().enumerate() {
                    for (tap, place) in
                        (0..4).filter_map(|tap| Some((tap, (2 * i + tap).checked_sub(1)?)))
                    {
                        for o in (0..2).filter(|_| place < 2 * length) {
                            let product: f32 = row
                                .iter()
                                .zip(&kernels)
                                .map(|(x, kernel)| x * kernel[tap][o])
                                .sum();
                            expected[(b * 2 * length + place) * 2 + o] += product;
                        }
                    }
                }
            }
            close(&double(&x, &kernel, &bias).unwrap(), &expected);
        }
    }

    #[test]
    fn gradients_are_those_of_finite_differences() {
        for (length, taps, stride) in [(6, 5, 1), (5, 3, 2), (3, 1, 1)] {
            let arguments = [random((2, length, 3), 6), random((taps, 3, 2), 7), random(2, 8)];
            let of = |x: &[Tensor]| convolve(&x[0], &x[1], &x[2], stride);
            check_gradients(&arguments, of);
            plainly(|| check_gradients(&arguments, of));
        }
        let arguments = [random((2, 3, 3), 9), random((3, 4, 2), 10), random(2, 11)];
        check_gradients(&arguments, |x| double(&x[0], &x[1], &x[2]));
    }
}
