//! Vectorised loops over activations: Mish and its derivative with one exponential.

use crate::vectorised::vectorised;

/// Below this, Mish and its slope are taken to be what they are here: some -2e-14, nothing beside numbers of order 1. Followed
/// further down, gradients behind such a unit would become subnormal numbers, with which a CPU is ten times slower.
const MISH_ZERO: f32 = -35.0;
/// Above this, Mish is x and its slope 1 to the last bit of f32; it keeps squares of e^x finite.
const MISH_LINEAR: f32 = 20.0;

/// e^x for x in [-35, 20], relative error below 2e-7.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // x = n ln 2 + r; adding 1.5·2^23 rounds to the integer n and leaves it in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-0.693_359_4, x);
    let r = n.mul_add(2.121_944_4e-4, r);
    let mut p = 1.987_569_1e-4_f32;
    p = p.mul_add(r, 1.398_199_9e-3);
    p = p.mul_add(r, 8.333_452e-3);
    p = p.mul_add(r, 4.166_579_6e-2);
    p = p.mul_add(r, 1.666_666_5e-1);
    p = p.mul_add(r, 0.5);
    let y = p.mul_add(r * r, r + 1.0);
    let scale = f32::from_bits((shifted.to_bits() << 23).wrapping_add(0x3f80_0000));
    y * scale
}

/// x·tanh(ln(1 + e^x)), by n/(n + 2) with n = e^x (e^x + 2).
#[inline(always)]
pub(crate) fn mish(x: f32) -> f32 {
    let x = x.clamp(MISH_ZERO, f32::INFINITY);
    let e = exp(x.clamp(MISH_ZERO, MISH_LINEAR));
    let n = e * (e + 2.0);
    x * (n / (n + 2.0))
}

/// Mish and its derivative. Finite for every finite x.
#[inline(always)]
pub(crate) fn mish_and_slope(x: f32) -> (f32, f32) {
    let x = x.clamp(MISH_ZERO, f32::INFINITY);
    let bounded = x.clamp(MISH_ZERO, MISH_LINEAR);
    let e = exp(bounded);
    let n = e * (e + 2.0);
    let r = 1.0 / (n + 2.0);
    let t = n * r;
    (x * t, (4.0 * bounded * r) * (e * (e + 1.0) * r) + t)
}

vectorised! {
    /// `x = mish(x)`.
    pub fn mish_in_place(x: &mut [f32]) {
        for x in x {
            *x = mish(*x);
        }
    }
}

vectorised! {
    /// `y = mish(x)`, `slope = mish'(x)`.
    pub fn mish_slope(x: &[f32], y: &mut [f32], slope: &mut [f32]) {
        for ((x, y), slope) in x.iter().zip(y).zip(slope) {
            (*y, *slope) = mish_and_slope(*x);
        }
    }
}

vectorised! {
    /// `x = mish(x + bias)`, row by row.
    pub fn bias_mish(x: &mut [f32], bias: &[f32]) {
        for row in x.chunks_exact_mut(bias.len()) {
            for (x, b) in row.iter_mut().zip(bias) {
                *x = mish(*x + b);
            }
        }
    }
}

vectorised! {
    /// `x = mish(x + bias)`, `slope = mish'(x + bias)`, row by row.
    pub fn bias_mish_slope(x: &mut [f32], bias: &[f32], slope: &mut [f32]) {
        for (row, slope) in x.chunks_exact_mut(bias.len()).zip(slope.chunks_exact_mut(bias.len())) {
            for ((x, b), slope) in row.iter_mut().zip(bias).zip(slope) {
                (*x, *slope) = mish_and_slope(*x + b);
            }
        }
    }
}

vectorised! {
    /// `x = x ⊙ y`.
    pub fn multiply(x: &mut [f32], y: &[f32]) {
        for (x, y) in x.iter_mut().zip(y) {
            *x *= y;
        }
    }
}

vectorised! {
    /// `out = Σ rows of x`, `out` is one row wide.
    pub fn column_sums(x: &[f32], out: &mut [f32]) {
        out.fill(0.0);
        for row in x.chunks_exact(out.len()) {
            for (out, x) in out.iter_mut().zip(row) {
                *out += x;
            }
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Mish and its derivative in double precision.
    pub(crate) fn mish_f64(x: f64) -> (f64, f64) {
        let softplus = if x > 30.0 { x } else { x.exp().ln_1p() };
        let t = softplus.tanh();
        (x * t, t + x * (1.0 - t * t) / (1.0 + (-x).exp()))
    }

    #[test]
    fn mish_matches_its_definition() {
        for i in -4000..=4000 {
            let x = i as f32 * 0.025;
            let (mut y, mut slope) = ([0.0], [0.0]);
            mish_slope(&[x], &mut y, &mut slope);
            let (y64, slope64) = mish_f64(f64::from(x));
            assert!((f64::from(y[0]) - y64).abs() <= 1e-6 * y64.abs() + 1e-12, "mish({x}) = {} for {y64}", y[0]);
            assert!((f64::from(slope[0]) - slope64).abs() <= 2e-6 * slope64.abs() + 1e-6, "mish'({x})");
        }
    }

    #[test]
    fn mish_is_finite_everywhere() {
        for x in [-f32::MAX, -1e30, -100.0, -0.0, 0.0, 88.0, 89.0, 1e4, 1e30] {
            let (mut y, mut slope) = ([0.0], [0.0]);
            mish_slope(&[x], &mut y, &mut slope);
            assert!(y[0].is_finite() && slope[0].is_finite(), "at {x}: {} {}", y[0], slope[0]);
        }
    }

    #[test]
    fn a_unit_that_is_off_makes_no_subnormal_numbers() {
        for x in [-30.0, -50.0, -87.0, -1e3, -1e30] {
            let (mut y, mut slope) = ([0.0], [0.0]);
            mish_slope(&[x], &mut y, &mut slope);
            assert!((1e-10 * y[0]).is_normal() && (1e-10 * slope[0]).is_normal(), "at {x}: {} {}", y[0], slope[0]);
        }
    }

    #[test]
    fn a_nan_is_not_hidden() {
        let (mut y, mut slope) = ([0.0], [0.0]);
        mish_slope(&[f32::NAN], &mut y, &mut slope);
        assert!(y[0].is_nan());
        mish_in_place(&mut y);
        assert!(y[0].is_nan());
    }
}
