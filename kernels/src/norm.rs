//! Layer norm (Ba et al. 2016) of a tile's rows, and its backward pass.
//!
//! What is kept of a tile for the backward pass is one slice: the gradients of scale and shift,
//! `width` numbers each; for each row one over its deviation; and the normalized rows, `rows ×
//! width`.

use crate::vectorized::vectorized;

/// Partial sums that are added up side by side: one AVX-512 register of f32.
const LANES: usize = 16;

/// Numbers that are kept of a tile.
pub fn kept(rows: usize, width: usize) -> usize {
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
    /// `x = scale ⊙ (z − mean)/√(variance + epsilon)` with z = x + bias, over each row. Fills
    /// `kept`.
    pub fn normalize(x: &mut [f32], bias: Option<&[f32]>, scale: &[f32], epsilon: f32, kept: &mut [f32]) {
        let width = scale.len();
        let (inverse, normed) = kept[2 * width..].split_at_mut(x.len() / width);
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
    /// Turns gradients behind a norm, `rows × width`, into those before it, and leaves the
    /// gradients of scale and shift in what [`normalize`] has kept.
    pub fn normalize_backward(delta: &mut [f32], scale: &[f32], kept: &mut [f32]) {
        let width = scale.len();
        let (sums, rows) = kept.split_at_mut(2 * width);
        let (inverse, normed) = rows.split_at(delta.len() / width);
        sums.fill(0.0);
        let (of_scale, of_shift) = sums.split_at_mut(width);
        let rows = delta.chunks_exact_mut(width).zip(normed.chunks_exact(width));
        for ((delta, normed), inverse) in rows.zip(inverse) {
            let columns = of_scale.iter_mut().zip(of_shift.iter_mut()).zip(scale);
            for ((delta, normed), ((of_scale, of_shift), scale)) in delta.iter_mut().zip(normed).zip(columns) {
                *of_scale += *delta * normed;
                *of_shift += *delta;
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
        let z: Vec<f64> =
            row.iter().zip(bias).map(|(x, b)| f64::from(*x) + f64::from(*b)).collect();
        let mean = z.iter().sum::<f64>() / z.len() as f64;
        let variance = z.iter().map(|z| (z - mean).powi(2)).sum::<f64>() / z.len() as f64;
        z.iter()
            .zip(scale)
            .map(|(z, s)| f64::from(*s) * (z - mean) / (variance + epsilon).sqrt())
            .collect()
    }

    #[test]
    fn a_norm_and_its_gradients_match_their_definition() {
        for width in [1, 5, 16, 40] {
            let numbers = |len: usize, by: f32| {
                (0..len).map(|i| (by * (i + 1) as f32).sin()).collect::<Vec<f32>>()
            };
            let (x, delta, rows) = (numbers(3 * width, 2.1), numbers(3 * width, 1.3), 3);
            let (bias, scale) = (numbers(width, 0.7), numbers(width, 0.3));
            let (mut y, mut keeps) = (x.clone(), vec![f32::NAN; kept(rows, width)]);
            normalize(&mut y, Some(&bias), &scale, 1e-2, &mut keeps);
            let loss = |x: &[f32], scale: &[f32]| -> f64 {
                let y = x.chunks(width).flat_map(|row| exact(row, &bias, scale, 1e-2));
                y.zip(&delta).map(|(y, delta)| y * f64::from(*delta)).sum()
            };
            for (found, row) in y.chunks(width).zip(x.chunks(width)) {
                let expected = exact(row, &bias, &scale, 1e-2);
                assert!(
                    found
                        .iter()
                        .zip(expected)
                        .all(|(y, exact)| (f64::from(*y) - exact).abs() < 1e-5),
                    "{width}"
                );
            }
            let mut found = delta.clone();
            normalize_backward(&mut found, &scale, &mut keeps);
            let moved = |numbers: &[f32], i: usize, by: f32| {
                let mut numbers = numbers.to_vec();
                numbers[i] += by;
                numbers
            };
            let slope = |of: &dyn Fn(f32) -> f64| (of(0.01) - of(-0.01)) / 0.02;
            for (i, found) in found.iter().enumerate() {
                let expected = slope(&|by| loss(&moved(&x, i, by), &scale));
                assert!(
                    (f64::from(*found) - expected).abs() < 1e-3 * (1.0 + expected.abs()),
                    "{width}, x {i}"
                );
            }
            for i in 0..width {
                let expected = slope(&|by| loss(&x, &moved(&scale, i, by)));
                assert!((f64::from(keeps[i]) - expected).abs() < 1e-3, "{width}, scale {i}");
                let sum: f32 = delta.chunks(width).map(|row| row[i]).sum();
                assert!((keeps[width + i] - sum).abs() < 1e-5, "{width}, shift {i}");
            }
        }
    }
}
