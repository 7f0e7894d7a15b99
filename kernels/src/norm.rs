//! Layer norm (Ba et al. 2016) of a tile's rows, and its backward pass.
//!
//! One slice is saved of a tile for the backward pass: the gradients of scale and shift, `width`
//! numbers each; 1/√(variance + ε) of each row; and the normalized rows, `rows × width`.

use crate::vectorized::vectorized;

/// Partial sums side by side: one AVX-512 register of f32.
const LANES: usize = 16;

/// Length of what is saved of a tile of `rows × width` numbers.
pub fn saved_len(rows: usize, width: usize) -> usize {
    2 * width + rows * (1 + width)
}

/// Mean of f(x, y) over two rows.
#[inline(always)]
fn mean(x: &[f32], y: &[f32], f: impl Fn(f32, f32) -> f32) -> f32 {
    let mut sums = [0.0_f32; LANES];
    let (whole, rest) = x.split_at(x.len() - x.len() % LANES);
    for (x, y) in whole.chunks_exact(LANES).zip(y.chunks_exact(LANES)) {
        for l in 0..LANES {
            sums[l] += f(x[l], y[l]);
        }
    }
    let mut sum = sums.iter().sum::<f32>();
    for (x, y) in rest.iter().zip(&y[whole.len()..]) {
        sum += f(*x, *y);
    }
    sum / x.len() as f32
}

vectorized! {
    /// `x = scale ⊙ (z − mean)/√(variance + epsilon)` with z = x + bias, over each row. Writes
    /// `saved`.
    pub fn normalize(x: &mut [f32], bias: Option<&[f32]>, scale: &[f32], epsilon: f32, saved: &mut [f32]) {
        let width = scale.len();
        let (inverse, normed) = saved[2 * width..].split_at_mut(x.len() / width);
        let rows = x.chunks_exact_mut(width).zip(normed.chunks_exact_mut(width));
        for ((x, normed), inverse) in rows.zip(inverse) {
            for (x, bias) in x.iter_mut().zip(bias.unwrap_or(&[])) {
                *x += bias;
            }
            let center = mean(x, x, |x, _| x);
            let variance = mean(x, x, |x, _| (x - center) * (x - center));
            *inverse = 1.0 / (variance + epsilon).sqrt();
            for ((x, normed), scale) in x.iter_mut().zip(normed).zip(scale) {
                *normed = (*x - center) * *inverse;
                *x = *normed * scale;
            }
        }
    }
}

vectorized! {
    /// `x = x + shift`, row by row.
    pub fn shift_rows(x: &mut [f32], shift: &[f32]) {
        for row in x.chunks_exact_mut(shift.len()) {
            row.iter_mut().zip(shift).for_each(|(x, shift)| *x += shift);
        }
    }
}

vectorized! {
    /// Turns gradients after a norm, `rows × width`, into those before it, and writes the
    /// gradients of scale and shift to `saved`.
    pub fn normalize_backward(delta: &mut [f32], scale: &[f32], saved: &mut [f32]) {
        let width = scale.len();
        let (sums, rows) = saved.split_at_mut(2 * width);
        let (inverse, normed) = rows.split_at(delta.len() / width);
        sums.fill(0.0);
        let (scale_gradient, shift_gradient) = sums.split_at_mut(width);
        let rows = delta.chunks_exact_mut(width).zip(normed.chunks_exact(width));
        for ((delta, normed), inverse) in rows.zip(inverse) {
            let columns = scale_gradient.iter_mut().zip(shift_gradient.iter_mut()).zip(scale);
            for ((delta, normed), ((scale_gradient, shift_gradient), scale)) in delta.iter_mut().zip(normed).zip(columns) {
                *scale_gradient += *delta * normed;
                *shift_gradient += *delta;
                *delta *= scale;
            }
            let center = mean(delta, delta, |delta, _| delta);
            let along = mean(delta, normed, |delta, normed| delta * normed);
            for (delta, normed) in delta.iter_mut().zip(normed) {
                *delta = (*delta - center - normed * along) * inverse;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The formulas in double precision.
    fn exact(row: &[f32], bias: &[f32], scale: &[f32], epsilon: f64) -> Vec<f64> {
        let z = row.iter().zip(bias).map(|(x, b)| f64::from(*x) + f64::from(*b));
        let z = Vec::from_iter(z);
        let mean = z.iter().sum::<f64>() / z.len() as f64;
        let variance = z.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / z.len() as f64;
        let deviation = (variance + epsilon).sqrt();
        let scaled = z.iter().zip(scale);
        scaled.map(|(z, scale)| f64::from(*scale) * (z - mean) / deviation).collect()
    }

    /// Finite differences of the formulas in double precision.
    #[test]
    fn a_norm_and_its_gradients_match_their_definition() {
        for width in [1, 5, 16, 40] {
            let numbers = |len: usize, by: f32| -> Vec<f32> {
                (0..len).map(|i| (by * (i + 1) as f32).sin()).collect()
            };
            let (x, delta, rows) = (numbers(3 * width, 2.1), numbers(3 * width, 1.3), 3);
            let (bias, scale) = (numbers(width, 0.7), numbers(width, 0.3));
            let (mut y, mut saved) = (x.clone(), vec![f32::NAN; saved_len(rows, width)]);
            normalize(&mut y, Some(&bias), &scale, 1e-2, &mut saved);
            let norm = |x: &[f32], scale: &[f32]| -> Vec<f64> {
                let rows = x.chunks(width);
                rows.flat_map(|row| exact(row, &bias, scale, 1e-2)).collect()
            };
            let near = |x: f32, y: f64, by: f64| (f64::from(x) - y).abs() < by * (1.0 + y.abs());
            for (y, exact) in y.iter().zip(norm(&x, &scale)) {
                assert!(near(*y, exact, 1e-5), "{width}: {y} for {exact}");
            }
            let mut x_gradient = delta.clone();
            normalize_backward(&mut x_gradient, &scale, &mut saved);
            let loss = |x: &[f32], scale: &[f32]| -> f64 {
                let y = norm(x, scale).into_iter();
                y.zip(&delta).map(|(y, delta)| y * f64::from(*delta)).sum()
            };
            let slope = |x: &[f32], i: usize, loss: &dyn Fn(&[f32]) -> f64| {
                let (mut above, mut below) = (x.to_vec(), x.to_vec());
                above[i] += 0.01;
                below[i] -= 0.01;
                (loss(&above) - loss(&below)) / 0.02
            };
            for (i, x_gradient) in x_gradient.iter().enumerate() {
                let expected = slope(&x, i, &|x| loss(x, &scale));
                assert!(near(*x_gradient, expected, 1e-3), "{width}, x {i}");
            }
            for i in 0..width {
                let scale_gradient = slope(&scale, i, &|scale| loss(&x, scale));
                assert!(near(saved[i], scale_gradient, 1e-3), "{width}, scale {i}");
                let sum: f32 = delta.chunks(width).map(|row| row[i]).sum();
                assert!((saved[width + i] - sum).abs() < 1e-5, "{width}, shift {i}");
            }
        }
    }
}
