//! Vectorized loops over activations and their derivatives, each with one exponential.

use crate::vectorized::vectorized;
use serde::{Deserialize, Serialize};

/// Below this, Mish and its slope are constants of about −2e-14. Smaller ones would lead to subnormal
/// gradients, with which a CPU is ten times slower.
const MISH_ZERO: f32 = -35.0;
/// Above this, Mish is x and its slope 1 to the last bit of f32; keeps squares of e^x finite.
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

/// Activation function of a hidden layer.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// x·tanh(ln(1 + e^x)).
    #[default]
    Mish,
    /// max(x, 0).
    Relu,
    /// x/(1 + e^-x), also called swish.
    Silu,
    /// tanh(x).
    Tanh,
    /// The tanh form of x·Φ(x) (Hendrycks and Gimpel 2016): x/2·(1 + tanh(√(2/π)·(x +
    /// 0.044715·x³))).
    Gelu,
}

/// Below this, GELU and its slope are constants of −8e-15; above [`GELU_LINEAR`], GELU is x to the
/// last bit of f32.
const GELU_ZERO: f32 = -6.9;
const GELU_LINEAR: f32 = 5.4;

/// GELU as x·σ(2u), where u is the argument of its tanh.
#[inline(always)]
pub(crate) fn gelu_and_slope(x: f32) -> (f32, f32) {
    const TWICE: f32 = 2.0 * 0.797_884_6; // 2·√(2/π)
    let x = x.clamp(GELU_ZERO, f32::INFINITY);
    let bounded = x.clamp(GELU_ZERO, GELU_LINEAR);
    let square = bounded * bounded;
    let e = exp(TWICE * bounded * square.mul_add(0.044_715, 1.0));
    let r = 1.0 / (e + 1.0);
    let s = e * r;
    (x * s, s * (bounded * r * TWICE * square.mul_add(3.0 * 0.044_715, 1.0) + 1.0))
}

/// The bound keeps e^2x, and with it tanh, finite; beyond it tanh is ±1 to the last bit of f32.
const TANH_FLAT: f32 = 9.5;

#[inline(always)]
pub(crate) fn tanh_and_slope(x: f32) -> (f32, f32) {
    let e = exp(2.0 * x.clamp(-TANH_FLAT, TANH_FLAT));
    let y = (e - 1.0) / (e + 1.0);
    (y, 1.0 - y * y)
}

#[inline(always)]
pub(crate) fn silu_and_slope(x: f32) -> (f32, f32) {
    let e = exp(x.clamp(MISH_ZERO, MISH_LINEAR));
    let s = e / (e + 1.0);
    let x = x.clamp(MISH_ZERO, f32::INFINITY);
    (x * s, s * (x * (1.0 - s) + 1.0))
}

#[inline(always)]
pub(crate) fn relu(x: f32) -> f32 {
    // Not `max`, which would drop a NaN.
    if x < 0.0 { 0.0 } else { x }
}

#[inline(always)]
fn relu_and_slope(x: f32) -> (f32, f32) {
    (relu(x), if x > 0.0 { 1.0 } else { 0.0 })
}

#[inline(always)]
fn rows(x: &mut [f32], bias: &[f32], f: impl Fn(f32) -> f32) {
    for row in x.chunks_exact_mut(bias.len()) {
        for (x, b) in row.iter_mut().zip(bias) {
            *x = f(*x + b);
        }
    }
}

#[inline(always)]
fn rows_with_slope(x: &mut [f32], bias: &[f32], slope: &mut [f32], f: impl Fn(f32) -> (f32, f32)) {
    for (row, slope) in x.chunks_exact_mut(bias.len()).zip(slope.chunks_exact_mut(bias.len())) {
        for ((x, b), slope) in row.iter_mut().zip(bias).zip(slope) {
            (*x, *slope) = f(*x + b);
        }
    }
}

vectorized! {
    /// `x = f(x + bias)`, row by row.
    pub fn activate(f: Activation, x: &mut [f32], bias: &[f32]) {
        match f {
            Activation::Mish => rows(x, bias, mish),
            Activation::Relu => rows(x, bias, relu),
            Activation::Silu => rows(x, bias, |x| silu_and_slope(x).0),
            Activation::Tanh => rows(x, bias, |x| tanh_and_slope(x).0),
            Activation::Gelu => rows(x, bias, |x| gelu_and_slope(x).0),
        }
    }
}

vectorized! {
    /// `x = f(x + bias)`, `slope = f'(x + bias)`, row by row.
    pub fn activate_with_slope(f: Activation, x: &mut [f32], bias: &[f32], slope: &mut [f32]) {
        match f {
            Activation::Mish => rows_with_slope(x, bias, slope, mish_and_slope),
            Activation::Relu => rows_with_slope(x, bias, slope, relu_and_slope),
            Activation::Silu => rows_with_slope(x, bias, slope, silu_and_slope),
            Activation::Tanh => rows_with_slope(x, bias, slope, tanh_and_slope),
            Activation::Gelu => rows_with_slope(x, bias, slope, gelu_and_slope),
        }
    }
}

vectorized! {
    /// `x = x ⊙ y`.
    pub fn multiply(x: &mut [f32], y: &[f32]) {
        for (x, y) in x.iter_mut().zip(y) {
            *x *= y;
        }
    }
}

vectorized! {
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
    use super::Activation::{Gelu, Mish, Relu, Silu, Tanh};
    use super::*;

    /// Mish and its derivative in double precision.
    pub(crate) fn mish_f64(x: f64) -> (f64, f64) {
        let softplus = if x > 30.0 { x } else { x.exp().ln_1p() };
        let t = softplus.tanh();
        (x * t, t + x * (1.0 - t * t) / (1.0 + (-x).exp()))
    }

    /// An activation and its derivative in double precision.
    fn exact(f: Activation, x: f64) -> (f64, f64) {
        let sigmoid = 1.0 / (1.0 + (-x).exp());
        match f {
            Mish => mish_f64(x),
            Relu => (x.max(0.0), f64::from(x > 0.0)),
            Silu => (x * sigmoid, sigmoid * (1.0 + x * (1.0 - sigmoid))),
            Tanh => (x.tanh(), 1.0 - x.tanh().powi(2)),
            Gelu => {
                let c = (2.0 / std::f64::consts::PI).sqrt();
                let t = (c * (x + 0.044715 * x.powi(3))).tanh();
                let inner = c * (1.0 + 0.134145 * x * x);
                let slope = 0.5 * (1.0 + t) + 0.5 * x * (1.0 - t * t) * inner;
                (0.5 * x * (1.0 + t), slope)
            }
        }
    }

    const ACTIVATIONS: [Activation; 5] = [Mish, Relu, Silu, Tanh, Gelu];

    /// Value and slope by the loop with slopes, of which the value is compared with the other loop.
    fn value_and_slope(f: Activation, x: f32) -> (f32, f32) {
        let (mut y, mut plain, mut slope) = ([x], [x], [0.0]);
        activate_with_slope(f, &mut y, &[0.0], &mut slope);
        activate(f, &mut plain, &[0.0]);
        let is_close = (y[0] - plain[0]).abs() <= 1e-6 * y[0].abs();
        assert!(is_close || x.is_nan(), "{f:?}({x})");
        (y[0], slope[0])
    }

    #[test]
    fn activations_match_their_definitions() {
        for (f, i) in ACTIVATIONS.into_iter().flat_map(|f| (-4000..=4000).map(move |i| (f, i))) {
            let x = i as f32 * 0.025;
            let (y, slope) = value_and_slope(f, x);
            let (y64, slope64) = exact(f, f64::from(x));
            let errors = [f64::from(y) - y64, f64::from(slope) - slope64].map(f64::abs);
            assert!(errors[0] <= 1e-6 * y64.abs() + 2e-7, "{f:?}({x})");
            assert!(errors[1] <= 2e-6 * slope64.abs() + 1e-6, "{f:?}'({x})");
        }
        let ratio = f64::from(value_and_slope(Mish, -30.0).0) / mish_f64(-30.0).0;
        assert!((ratio - 1.0).abs() < 1e-6, "{ratio}");
    }

    #[test]
    fn activations_are_finite_and_a_nan_is_kept() {
        for f in ACTIVATIONS {
            for x in [-f32::MAX, -1e30, -100.0, -0.0, 88.0, 89.0, 1e30] {
                let (y, slope) = value_and_slope(f, x);
                assert!(y.is_finite() && slope.is_finite(), "{f:?}({x})");
            }
            assert!(value_and_slope(f, f32::NAN).0.is_nan(), "{f:?}");
        }
    }

    #[test]
    fn a_unit_that_is_off_makes_no_subnormal_numbers() {
        for f in [Mish, Silu, Gelu] {
            for x in [-30.0, -87.0, -1e30] {
                let (y, slope) = value_and_slope(f, x);
                let is_normal = (1e-10 * y).is_normal() && (1e-10 * slope).is_normal();
                assert!(is_normal, "{f:?}({x})");
            }
        }
    }
}
