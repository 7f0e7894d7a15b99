//! Dense products on one thread, all matrices row-major.
//!
//! Callers run tiles in parallel; a single product uses one thread. With [`Precision::Bf16`] a product
//! rounds its factors where they are whole blocks of 32 in width and in the length of sums; others
//! would gain too little.

use gemm::{Parallelism, gemm};
#[cfg(target_arch = "x86_64")]
use gemm_common::{
    gemm::gemm_basic_generic,
    simd::{MixedSimd, V3},
};

#[cfg(target_arch = "x86_64")]
use crate::avx512;
use crate::level::Level;
#[cfg(target_arch = "x86_64")]
pub use crate::packed::Packed;
use crate::precision::Precision;

/// The left or right side of a product.
#[derive(Clone, Copy)]
pub enum Matrix<'a> {
    /// The matrix with these elements, row by row.
    RowMajor(&'a [f32]),
    /// The transpose of the matrix with these elements, row by row.
    TransposeOf(&'a [f32]),
    /// The transpose of some columns of a matrix: its elements, row by row; the first of these
    /// columns; and the number of columns in all.
    TransposeOfColumns(&'a [f32], usize, usize),
}

/// In a product with a transpose, the crate `gemm` adds in another order where the result has one row
/// or at most this many numbers.
const FEW: usize = 256;

/// First element, column stride, row stride.
type Strided = (*const f32, isize, isize);

#[cfg(target_arch = "x86_64")]
impl From<Strided> for avx512::Strided<f32> {
    fn from((first, column, row): Strided) -> Self {
        Self { first, row: row as usize, column: column as usize }
    }
}

impl Matrix<'_> {
    fn strided(self, rows: usize, columns: usize) -> Strided {
        let (elements, column, row, from, len) = match self {
            Self::RowMajor(elements) => (elements, 1, columns, 0, rows * columns),
            Self::TransposeOf(elements) => (elements, rows, 1, 0, rows * columns),
            Self::TransposeOfColumns(elements, from, width) => {
                assert!(from + rows <= width, "columns of an operand");
                (elements, width, 1, from, width * columns)
            }
        };
        assert_eq!(elements.len(), len, "operands of a product");
        (elements[from..].as_ptr(), column as isize, row as isize)
    }
}

/// `out[m × n] = a[m × k] · b[k × n]` by the crate `gemm`, with the instructions in use ([`Level`]).
pub fn by_gemm([m, k, n]: [usize; 3], a: Matrix, b: Matrix, out: &mut [f32]) {
    let (a, b) = (a.strided(m, k), b.strided(k, n));
    assert_eq!(out.len(), m * n, "the product's shape");
    #[cfg(target_arch = "x86_64")]
    if Level::in_use() == Level::Avx2
        && let Some(avx2) = <V3 as MixedSimd<f32, f32, f32, f32>>::try_new()
    {
        // SAFETY: the operands span m × k and k × n elements, `out` is an exclusive slice of m × n.
        return unsafe { by_avx2(avx2, [m, n, k], out, a, b) };
    }
    let (no, one) = (false, Parallelism::None);
    // SAFETY: as above.
    unsafe {
        let out = out.as_mut_ptr();
        gemm(
            m, n, k, out, 1, n as isize, no, a.0, a.1, a.2, b.0, b.1, b.2, 0.0, 1.0, no, no, no,
            one,
        );
    }
}

/// The product as `gemm` computes it on a CPU without AVX-512.
///
/// # Safety
/// The matrices must span that many elements.
#[cfg(target_arch = "x86_64")]
unsafe fn by_avx2(avx2: V3, [m, n, k]: [usize; 3], out: &mut [f32], a: Strided, b: Strided) {
    use gemm_f32::microkernel::fma::f32::{H_M, H_N, H_UKR, MR_DIV_N, NR, UKR};
    const LANES: usize = 8;
    let (no, one) = (false, Parallelism::None);
    let (out, row, fma) = (out.as_mut_ptr(), n as isize, |a, b, c| a * b + c);
    // SAFETY: the caller's. Its kernels write columns, so it is given the transposed matrices.
    unsafe {
        gemm_basic_generic::<_, f32, LANES, { MR_DIV_N * LANES }, NR, MR_DIV_N, H_M, H_N>(
            avx2, n, m, k, out, row, 1, no, b.0, b.2, b.1, a.0, a.2, a.1, 0.0, 1.0, no, no, no,
            fma, &UKR, &H_UKR, no, one,
        );
    }
}

/// Computes the product in bf16 if that is asked for, and CPU and sizes allow. Returns true if so.
#[cfg_attr(not(target_arch = "x86_64"), expect(unused_variables))]
fn multiply_rounded(
    precision: Precision,
    [m, k, n]: [usize; 3],
    a: Matrix,
    b: Matrix,
    out: &mut [f32],
) -> bool {
    #[cfg(target_arch = "x86_64")]
    if precision == Precision::Bf16 {
        let [a, b] = [a.strided(m, k), b.strided(k, n)].map(avx512::Strided::from);
        assert_eq!(out.len(), m * n, "the product's shape");
        let serves = avx512::bf16::serves([m, k, n], a);
        if serves {
            // SAFETY: the CPU can; as in `by_gemm`.
            unsafe { avx512::bf16::multiply([m, k, n], a, b, out.as_mut_ptr()) };
        }
        return serves;
    }
    false
}

/// The product by AVX-512, if the CPU and the width allow, or by `gemm`.
fn multiply(precision: Precision, [m, k, n]: [usize; 3], a: Matrix, b: &[f32], out: &mut [f32]) {
    if multiply_rounded(precision, [m, k, n], a, Matrix::RowMajor(b), out) {
        return;
    }
    #[cfg(target_arch = "x86_64")]
    if avx512::serves(n) {
        let (a, b) = (a.strided(m, k).into(), Matrix::RowMajor(b).strided(k, n));
        assert_eq!(out.len(), m * n, "the product's shape");
        // SAFETY: as in `by_gemm`.
        return unsafe { avx512::multiply(m, n, k, a, b.0, out.as_mut_ptr()) };
    }
    by_gemm([m, k, n], a, Matrix::RowMajor(b), out);
}

/// `out[m × n] = x[m × k] · w[k × n]`.
pub fn product(precision: Precision, x: &[f32], w: &[f32], out: &mut [f32], k: usize, n: usize) {
    multiply(precision, [x.len() / k, k, n], Matrix::RowMajor(x), w, out);
}

/// No kernels are packed on other architectures.
#[cfg(not(target_arch = "x86_64"))]
pub enum Packed {}

#[cfg(not(target_arch = "x86_64"))]
impl Packed {
    pub fn new(_: Precision, _: &[f32], _: usize, _: usize) -> Option<Self> {
        None
    }

    pub fn product(&self, _: &[f32], _: &mut [f32]) {
        match *self {}
    }
}

/// `out[m × k] = g[m × n] · w[k × n]ᵀ`: a gradient's backward pass through `product`. The bits of a
/// row do not depend on the number of rows.
pub fn product_transposed(
    precision: Precision,
    g: &[f32],
    w: &[f32],
    out: &mut [f32],
    k: usize,
    n: usize,
) {
    let (m, left, right) = (g.len() / n, Matrix::RowMajor(g), Matrix::TransposeOf(w));
    if multiply_rounded(precision, [m, n, k], left, right, out) {
        return;
    }
    #[cfg(target_arch = "x86_64")]
    if avx512::serves(n) && avx512::serves(k) {
        assert!(g.len() == m * n && w.len() == k * n, "operands of a product");
        assert_eq!(out.len(), m * k, "the product's shape");
        // SAFETY: as in `by_gemm`.
        return unsafe {
            avx512::multiply_transposed(m, k, n, g.as_ptr(), w.as_ptr(), out.as_mut_ptr())
        };
    }
    let least = (FEW / k + 1).max(2);
    if m < least {
        let rows = [g, &vec![0.0; (least - m) * n][..]].concat();
        let mut products = vec![0.0; least * k];
        by_gemm([least, n, k], Matrix::RowMajor(&rows), right, &mut products);
        return out.copy_from_slice(&products[..m * k]);
    }
    by_gemm([m, n, k], left, right, out);
}

/// `out[k × n] = x[m × k]ᵀ · g[m × n]`: the gradient of `w` in `product`.
pub fn outer(precision: Precision, x: &[f32], g: &[f32], out: &mut [f32], k: usize, n: usize) {
    outer_rows(precision, x, g, out, (0, k), n);
}

/// The rows of [`outer`]'s result from `from` on, as many as fit into `out`.
pub fn outer_rows(
    precision: Precision,
    x: &[f32],
    g: &[f32],
    out: &mut [f32],
    (from, k): (usize, usize),
    n: usize,
) {
    let sizes = [out.len() / n, x.len() / k, n];
    multiply(precision, sizes, Matrix::TransposeOfColumns(x, from, k), g, out);
}

#[cfg(test)]
mod tests {
    use super::*;
    use Precision::{Bf16, F32};
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Whole blocks of rows and others, columns for AVX-512 and others.
    #[test]
    fn products_match_their_definition() {
        let generator = &mut ChaCha8Rng::seed_from_u64(0);
        let mut numbers = |len: usize| -> Vec<f32> {
            (0..len).map(|_| generator.random_range(-1.0..1.0)).collect()
        };
        let small = [[1, 3, 1], [5, 14, 32], [7, 11, 23], [12, 32, 64], [16, 33, 32]];
        let large =
            [[29, 64, 96], [41, 96, 32], [9, 512, 32], [7, 32, 512], [32, 96, 64], [256, 256, 32]];
        for [m, k, n] in small.into_iter().chain(large) {
            let (x, w, g) = (numbers(m * k), numbers(k * n), numbers(m * n));
            let sum = |len: usize, term: &dyn Fn(usize) -> (f32, f32)| -> f64 {
                (0..len).map(term).map(|(a, b)| f64::from(a) * f64::from(b)).sum()
            };
            let what = format!("{m} × {k} × {n}");
            for precision in [F32, Bf16] {
                // Rounding two factors changes their product by at most a part in 2^7.
                let close =
                    |name: &str, out: &[f32], len, term: &dyn Fn(usize, usize) -> (f32, f32)| {
                        for (i, x) in out.iter().enumerate() {
                            let exact = sum(len, &|p| term(i, p));
                            let terms = sum(len, &|p| (term(i, p).0.abs(), term(i, p).1.abs()));
                            let bound = if precision == F32 { 1e-5 } else { terms / 128.0 };
                            let error = (f64::from(*x) - exact).abs();
                            assert!(
                                error <= bound * exact.abs().max(1.0),
                                "{name} in {precision:?}, {what} at {i}: {x} for {exact}"
                            );
                        }
                    };
                let mut out = vec![f32::NAN; m * n];
                let term = |i: usize, p: usize| (x[i / n * k + p], w[p * n + i % n]);
                product(precision, &x, &w, &mut out, k, n);
                close("product", &out, k, &term);
                if let Some(packed) = Packed::new(precision, &w, k, n) {
                    let unpacked = std::mem::replace(&mut out, vec![f32::NAN; m * n]);
                    packed.product(&x, &mut out);
                    close("packed product", &out, k, &term);
                    let same = out == unpacked || !k.is_multiple_of(32) || !n.is_multiple_of(32);
                    assert!(same || Level::in_use() != Level::Avx512, "{what}, {precision:?}");
                }
                let mut out = vec![f32::NAN; m * k];
                product_transposed(precision, &g, &w, &mut out, k, n);
                close("product with the transpose", &out, n, &|i, p| {
                    (g[i / k * n + p], w[i % k * n + p])
                });
                let mut out = vec![f32::NAN; k * n];
                outer(precision, &x, &g, &mut out, k, n);
                close("outer product", &out, m, &|i, p| (x[p * k + i / n], g[p * n + i % n]));
                let (whole, from) = (out.clone(), k / 64 * 32);
                let (above, below) = out.split_at_mut(from * n);
                above.fill(f32::NAN);
                outer_rows(precision, &x, &g, above, (0, k), n);
                outer_rows(precision, &x, &g, below, (from, k), n);
                assert_eq!(out, whole, "{what}, outer product in two parts");
            }
        }
    }

    /// Guidance takes gradients of as many rows as there are candidates in a batch of episodes, none
    /// of which may depend on others.
    #[test]
    fn a_row_of_a_transposed_product_does_not_depend_on_others() {
        let generator = &mut ChaCha8Rng::seed_from_u64(1);
        let mut numbers = |len: usize| -> Vec<f32> {
            (0..len).map(|_| generator.random_range(-1.0..1.0)).collect()
        };
        for (k, n) in [(17, 64), (40, 256), (48, 48), (256, 40), (64, 64)] {
            let (g, w) = (numbers(128 * n), numbers(k * n));
            for precision in [F32, Bf16] {
                let rows = |m: usize| {
                    let mut out = vec![f32::NAN; m * k];
                    product_transposed(precision, &g[..m * n], &w, &mut out, k, n);
                    out
                };
                let whole = rows(128);
                for m in [1, 2, 6, 15, 70] {
                    assert_eq!(rows(m), whole[..m * k], "{m} rows, {k} × {n}, {precision:?}");
                }
            }
        }
    }
}
