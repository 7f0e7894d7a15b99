//! The narrow first and last layer of a network, fused with the activations beside them.
//!
//! Matrices are row-major slices; `width` is the number of columns.

use crate::activation::{Activation, gelu_and_slope, mish, relu, silu_and_slope, tanh_and_slope};
use crate::vectorized::vectorized;

/// Numbers of one AVX-512 register.
const LANES: usize = 16;

/// `acc + Σ_j coefficients[j] · vectors[j·stride + column ..][..LANES]`.
#[inline(always)]
fn combine(
    mut acc: [f32; LANES],
    coefficients: &[f32],
    vectors: &[f32],
    stride: usize,
    column: usize,
) -> [f32; LANES] {
    for (j, c) in coefficients.iter().enumerate() {
        let v = &vectors[j * stride + column..][..LANES];
        for l in 0..LANES {
            acc[l] = c.mul_add(v[l], acc[l]);
        }
    }
    acc
}

/// [`combine`] for one column.
#[inline(always)]
fn combine_one(
    mut acc: f32,
    coefficients: &[f32],
    vectors: &[f32],
    stride: usize,
    column: usize,
) -> f32 {
    for (j, c) in coefficients.iter().enumerate() {
        acc = c.mul_add(vectors[j * stride + column], acc);
    }
    acc
}

#[inline(always)]
fn load(x: &[f32], column: usize) -> [f32; LANES] {
    let mut lanes = [0.0; LANES];
    lanes.copy_from_slice(&x[column..column + LANES]);
    lanes
}

/// Operands of the first layer.
#[derive(Clone, Copy)]
pub struct FirstLayer<'a> {
    /// State part of the pre-activation, `states × width`.
    pub base: &'a [f32],
    /// Consecutive rows that share a state.
    pub repeat: usize,
    /// Bias, and for the actor the time embedding's part.
    pub shift: &'a [f32],
    /// `rows × action_dim`; action_dim can be 0.
    pub actions: &'a [f32],
    /// The kernel's rows for the action, `action_dim × width`.
    pub kernel: &'a [f32],
}

impl FirstLayer<'_> {
    #[inline(always)]
    fn action(&self, row: usize) -> &[f32] {
        let action_dim = self.kernel.len() / self.shift.len();
        &self.actions[row * action_dim..][..action_dim]
    }

    /// base + shift + a · kernel of one row, [`LANES`] columns from `column` on.
    #[inline(always)]
    fn before_activation(&self, base: &[f32], a: &[f32], column: usize) -> [f32; LANES] {
        let (mut sum, shift) = (load(base, column), load(self.shift, column));
        for l in 0..LANES {
            sum[l] += shift[l];
        }
        combine(sum, a, self.kernel, self.shift.len(), column)
    }
}

#[inline(always)]
fn first_rows(layer: &FirstLayer<'_>, out: &mut [f32], f: impl Fn(f32) -> f32) {
    let width = layer.shift.len();
    for (row, out) in out.chunks_exact_mut(width).enumerate() {
        let a = layer.action(row);
        let base = &layer.base[row / layer.repeat * width..][..width];
        let whole = width - width % LANES;
        for column in (0..whole).step_by(LANES) {
            let acc = layer.before_activation(base, a, column);
            let out = &mut out[column..column + LANES];
            for l in 0..LANES {
                out[l] = f(acc[l]);
            }
        }
        for column in whole..width {
            out[column] =
                f(combine_one(base[column] + layer.shift[column], a, layer.kernel, width, column));
        }
    }
}

vectorized! {
    /// `out = f(base + shift + actions · kernel)`, `rows × width`; without f the sum itself.
    pub fn first_layer(f: Option<Activation>, layer: &FirstLayer<'_>, out: &mut [f32]) {
        match f {
            None => first_rows(layer, out, |x| x),
            Some(Activation::Mish) => first_rows(layer, out, mish),
            Some(Activation::Relu) => first_rows(layer, out, relu),
            Some(Activation::Silu) => first_rows(layer, out, |x| silu_and_slope(x).0),
            Some(Activation::Tanh) => first_rows(layer, out, |x| tanh_and_slope(x).0),
            Some(Activation::Gelu) => first_rows(layer, out, |x| gelu_and_slope(x).0),
        }
    }
}

vectorized! {
    /// `slope = slope ⊙ (coefficients · vectors)`: the gradient before an activation whose output
    /// feeds a narrow linear layer. `coefficients` is `rows × n`, `vectors` `n × width`.
    pub fn scale_by_combination(slope: &mut [f32], coefficients: &[f32], vectors: &[f32], width: usize) {
        let n = vectors.len() / width;
        for (slope, c) in slope.chunks_exact_mut(width).zip(coefficients.chunks_exact(n)) {
            let whole = width - width % LANES;
            for column in (0..whole).step_by(LANES) {
                let acc = combine([0.0; LANES], c, vectors, width, column);
                let slope = &mut slope[column..column + LANES];
                for l in 0..LANES {
                    slope[l] *= acc[l];
                }
            }
            for (column, slope) in slope.iter_mut().enumerate().skip(whole) {
                *slope *= combine_one(0.0, c, vectors, width, column);
            }
        }
    }
}

vectorized! {
    /// `out[row, j] = offset[j] + x[row] · vectors[j]`: a narrow linear layer. `vectors` is `n ×
    /// width`.
    pub fn dots(x: &[f32], vectors: &[f32], offset: &[f32], out: &mut [f32], width: usize) {
        for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(offset.len())) {
            for ((out, v), offset) in out.iter_mut().zip(vectors.chunks_exact(width)).zip(offset) {
                let whole = width - width % LANES;
                let mut acc = [0.0_f32; LANES];
                for column in (0..whole).step_by(LANES) {
                    let (x, v) = (load(x, column), load(v, column));
                    for l in 0..LANES {
                        acc[l] = x[l].mul_add(v[l], acc[l]);
                    }
                }
                let mut sum = *offset;
                for l in acc {
                    sum += l;
                }
                for column in whole..width {
                    sum = x[column].mul_add(v[column], sum);
                }
                *out = sum;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::activation::tests::mish_f64;

    #[test]
    fn widths_that_fill_no_register_are_handled() {
        for width in [1, 5, 16, 23] {
            let x: Vec<f32> = (0..3 * width).map(|i| i as f32 * 0.1 - 1.0).collect();
            let v: Vec<f32> = (0..2 * width).map(|i| (i as f32).sin()).collect();
            let mut out = [0.0; 6];
            dots(&x, &v, &[0.5, -0.5], &mut out, width);
            for (row, out) in out.chunks(2).enumerate() {
                for (j, out) in out.iter().enumerate() {
                    let sum: f32 = (0..width).map(|h| x[row * width + h] * v[j * width + h]).sum();
                    assert!((out - (sum + [0.5, -0.5][j])).abs() < 1e-5);
                }
            }
            let layer = FirstLayer {
                base: &x,
                repeat: 1,
                shift: &v[..width],
                actions: &[0.3, -0.2, 0.9],
                kernel: &v[width..],
            };
            let mut y = vec![0.0; 3 * width];
            first_layer(Some(Activation::Mish), &layer, &mut y);
            for (i, y) in y.iter().enumerate() {
                let pre = x[i] + v[i % width] + [0.3, -0.2, 0.9][i / width] * v[width + i % width];
                assert!((f64::from(*y) - mish_f64(f64::from(pre)).0).abs() < 1e-5);
            }
        }
    }
}
