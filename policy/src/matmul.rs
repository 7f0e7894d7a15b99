//! Dense products on one thread, by the `gemm` crate. All matrices are row-major.
//!
//! The callers split work into tiles that run in parallel, so a single product never does.

use gemm::{Parallelism, gemm};

/// A row-major matrix or its transpose, as `gemm` wants it: first element, column stride, row stride.
type Operand = (*const f32, isize, isize);

fn multiply(m: usize, n: usize, k: usize, out: &mut [f32], a: Operand, b: Operand) {
    assert_eq!(out.len(), m * n, "the product's shape");
    // SAFETY: the three callers below check that `a` spans m × k and `b` k × n elements with these strides, and
    // `out` is an exclusive slice of m × n.
    unsafe {
        gemm(
            m,
            n,
            k,
            out.as_mut_ptr(),
            1,
            n as isize,
            false,
            a.0,
            a.1,
            a.2,
            b.0,
            b.1,
            b.2,
            0.0,
            1.0,
            false,
            false,
            false,
            Parallelism::None,
        );
    }
}

/// `out[m × n] = x[m × k] · w[k × n]`.
pub(crate) fn product(x: &[f32], w: &[f32], out: &mut [f32], k: usize, n: usize) {
    let m = x.len() / k;
    assert!(x.len() == m * k && w.len() == k * n, "operands of a product");
    multiply(m, n, k, out, (x.as_ptr(), 1, k as isize), (w.as_ptr(), 1, n as isize));
}

/// `out[m × k] = g[m × n] · w[k × n]ᵀ`: a gradient's way back through `product`.
pub(crate) fn product_transposed(g: &[f32], w: &[f32], out: &mut [f32], k: usize, n: usize) {
    let m = g.len() / n;
    assert!(g.len() == m * n && w.len() == k * n, "operands of a product");
    multiply(m, k, n, out, (g.as_ptr(), 1, n as isize), (w.as_ptr(), n as isize, 1));
}

/// `out[k × n] = x[m × k]ᵀ · g[m × n]`: the gradient of `w` in `product`.
pub(crate) fn outer(x: &[f32], g: &[f32], out: &mut [f32], k: usize, n: usize) {
    let m = x.len() / k;
    assert!(x.len() == m * k && g.len() == m * n, "operands of a product");
    multiply(k, n, m, out, (x.as_ptr(), k as isize, 1), (g.as_ptr(), 1, n as isize));
}
