//! Vectorised loops over activations: Mish and its derivative with one exponential, and the narrow first and last
//! layers fused with them. Each loop is compiled for several instruction sets and chosen at run time.
//!
//! Matrices are row-major slices; `width` is the number of columns.

use multiversion::multiversion;

/// Lanes that the loops work on at a time: one AVX-512 register of f32.
const LANES: usize = 16;

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
fn mish(x: f32) -> f32 {
    let x = x.clamp(MISH_ZERO, f32::INFINITY);
    let e = exp(x.clamp(MISH_ZERO, MISH_LINEAR));
    let n = e * (e + 2.0);
    x * (n / (n + 2.0))
}

/// Mish and its derivative. Finite for every finite x.
#[inline(always)]
fn mish_and_slope(x: f32) -> (f32, f32) {
    let x = x.clamp(MISH_ZERO, f32::INFINITY);
    let bounded = x.clamp(MISH_ZERO, MISH_LINEAR);
    let e = exp(bounded);
    let n = e * (e + 2.0);
    let r = 1.0 / (n + 2.0);
    let t = n * r;
    (x * t, (4.0 * bounded * r) * (e * (e + 1.0) * r) + t)
}

macro_rules! vectorised {
    ($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[multiversion(targets(
            "x86_64+avx512f+avx512dq+avx512vl+avx512bw+avx2+fma+bmi1+bmi2",
            "x86_64+avx2+fma+bmi1+bmi2",
        ))]
        $vis fn $name($($arg: $ty),*) $body
    };
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

/// `acc + Σ_j coefficients[j] · vectors[j·stride + at ..][..LANES]`.
#[inline(always)]
fn combine(mut acc: [f32; LANES], coefficients: &[f32], vectors: &[f32], stride: usize, at: usize) -> [f32; LANES] {
    for (j, c) in coefficients.iter().enumerate() {
        let v = &vectors[j * stride + at..][..LANES];
        for l in 0..LANES {
            acc[l] = c.mul_add(v[l], acc[l]);
        }
    }
    acc
}

/// The same for one column.
#[inline(always)]
fn combine_one(mut acc: f32, coefficients: &[f32], vectors: &[f32], stride: usize, at: usize) -> f32 {
    for (j, c) in coefficients.iter().enumerate() {
        acc = c.mul_add(vectors[j * stride + at], acc);
    }
    acc
}

#[inline(always)]
fn load(x: &[f32], at: usize) -> [f32; LANES] {
    let mut lanes = [0.0; LANES];
    lanes.copy_from_slice(&x[at..at + LANES]);
    lanes
}

/// Operands of the first layer: what the rows share, and what they do not.
pub struct FirstLayer<'a> {
    /// Pre-activation of the state part, one row per state: `states × width`.
    pub base: &'a [f32],
    /// Consecutive rows that share a state.
    pub repeat: usize,
    /// Added to every row: the bias, and for the actor the time embedding's part.
    pub shift: &'a [f32],
    /// `rows × action_dim`; the action may have no numbers at all.
    pub actions: &'a [f32],
    /// The kernel's rows that multiply the action: `action_dim × width`.
    pub kernel: &'a [f32],
}

impl FirstLayer<'_> {
    /// The action of a row; empty where the network has none.
    #[inline(always)]
    fn action(&self, row: usize) -> &[f32] {
        let action_dim = self.kernel.len() / self.shift.len();
        &self.actions[row * action_dim..][..action_dim]
    }

    /// base + shift + a · kernel of one row, [`LANES`] columns from `at` on.
    #[inline(always)]
    fn before_activation(&self, base: &[f32], a: &[f32], at: usize) -> [f32; LANES] {
        let (mut sum, shift) = (load(base, at), load(self.shift, at));
        for l in 0..LANES {
            sum[l] += shift[l];
        }
        combine(sum, a, self.kernel, self.shift.len(), at)
    }
}

vectorised! {
    /// `out = mish(base + shift + actions · kernel)`, `rows × width`.
    pub fn first_layer(layer: &FirstLayer<'_>, out: &mut [f32]) {
        let width = layer.shift.len();
        for (row, out) in out.chunks_exact_mut(width).enumerate() {
            let a = layer.action(row);
            let base = &layer.base[row / layer.repeat * width..][..width];
            let whole = width - width % LANES;
            for at in (0..whole).step_by(LANES) {
                let acc = layer.before_activation(base, a, at);
                let out = &mut out[at..at + LANES];
                for l in 0..LANES {
                    out[l] = mish(acc[l]);
                }
            }
            for at in whole..width {
                out[at] = mish(combine_one(base[at] + layer.shift[at], a, layer.kernel, width, at));
            }
        }
    }
}

vectorised! {
    /// `first_layer` that also keeps the slope for the way back.
    pub fn first_layer_slope(layer: &FirstLayer<'_>, out: &mut [f32], slope: &mut [f32]) {
        let width = layer.shift.len();
        for (row, (out, slope)) in out.chunks_exact_mut(width).zip(slope.chunks_exact_mut(width)).enumerate() {
            let a = layer.action(row);
            let base = &layer.base[row / layer.repeat * width..][..width];
            let whole = width - width % LANES;
            for at in (0..whole).step_by(LANES) {
                let acc = layer.before_activation(base, a, at);
                let (out, slope) = (&mut out[at..at + LANES], &mut slope[at..at + LANES]);
                for l in 0..LANES {
                    (out[l], slope[l]) = mish_and_slope(acc[l]);
                }
            }
            for at in whole..width {
                let x = combine_one(base[at] + layer.shift[at], a, layer.kernel, width, at);
                (out[at], slope[at]) = mish_and_slope(x);
            }
        }
    }
}

vectorised! {
    /// `slope = slope ⊙ (coefficients · vectors)`: the gradient before an activation whose output feeds a narrow
    /// linear layer. `coefficients` is `rows × n`, `vectors` `n × width`.
    pub fn scale_by_combination(slope: &mut [f32], coefficients: &[f32], vectors: &[f32], width: usize) {
        let n = vectors.len() / width;
        for (slope, c) in slope.chunks_exact_mut(width).zip(coefficients.chunks_exact(n)) {
            let whole = width - width % LANES;
            for at in (0..whole).step_by(LANES) {
                let acc = combine([0.0; LANES], c, vectors, width, at);
                let slope = &mut slope[at..at + LANES];
                for l in 0..LANES {
                    slope[l] *= acc[l];
                }
            }
            for (at, slope) in slope.iter_mut().enumerate().skip(whole) {
                *slope *= combine_one(0.0, c, vectors, width, at);
            }
        }
    }
}

vectorised! {
    /// `out[row, j] = offset[j] + x[row] · vectors[j]`: a narrow linear layer. `vectors` is `n × width`.
    pub fn dots(x: &[f32], vectors: &[f32], offset: &[f32], out: &mut [f32], width: usize) {
        for (x, out) in x.chunks_exact(width).zip(out.chunks_exact_mut(offset.len())) {
            for ((out, v), offset) in out.iter_mut().zip(vectors.chunks_exact(width)).zip(offset) {
                let whole = width - width % LANES;
                let mut acc = [0.0_f32; LANES];
                for at in (0..whole).step_by(LANES) {
                    let (x, v) = (load(x, at), load(v, at));
                    for l in 0..LANES {
                        acc[l] = x[l].mul_add(v[l], acc[l]);
                    }
                }
                let mut sum = *offset;
                for l in acc {
                    sum += l;
                }
                for at in whole..width {
                    sum = x[at].mul_add(v[at], sum);
                }
                *out = sum;
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
mod tests {
    use super::*;

    fn mish_f64(x: f64) -> (f64, f64) {
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
            let layer =
                FirstLayer { base: &x, repeat: 1, shift: &v[..width], actions: &[0.3, -0.2, 0.9], kernel: &v[width..] };
            let (mut plain, mut y, mut slope) = (vec![0.0; 3 * width], vec![0.0; 3 * width], vec![0.0; 3 * width]);
            first_layer(&layer, &mut plain);
            first_layer_slope(&layer, &mut y, &mut slope);
            assert_eq!(plain.len(), y.len());
            for i in 0..3 * width {
                let pre = x[i] + v[i % width] + [0.3, -0.2, 0.9][i / width] * v[width + i % width];
                let (y64, slope64) = mish_f64(f64::from(pre));
                assert!((f64::from(plain[i]) - y64).abs() < 1e-5 && (f64::from(y[i]) - y64).abs() < 1e-5);
                assert!((f64::from(slope[i]) - slope64).abs() < 1e-5);
            }
        }
    }
}
