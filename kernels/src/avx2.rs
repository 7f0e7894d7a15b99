//! Products with a packed right-hand side for CPUs with AVX2 and FMA.

use std::arch::x86_64::{
    _MM_HINT_T0, _mm_prefetch, _mm256_broadcast_ss, _mm256_fmadd_ps, _mm256_loadu_ps,
    _mm256_setzero_ps, _mm256_storeu_ps,
};

const LANES: usize = 8;
/// Columns of a block of the result: two registers.
pub(crate) const COLUMNS: usize = 2 * LANES;
/// Rows of a block of the result: its sums fill most of the 16 registers.
const ROWS: usize = 6;

/// `R` rows of one block of columns: `c = a · b`, `a` being `R × k` and `b` `k × 16`.
///
/// # Safety
/// The matrices must span that many elements; rows of `c` are `c_row` elements apart.
#[inline]
#[target_feature(enable = "avx2,fma")]
unsafe fn block<const R: usize>(k: usize, a: *const f32, b: *const f32, c: *mut f32, c_row: usize) {
    // SAFETY: the caller's.
    unsafe {
        let mut sums = [[_mm256_setzero_ps(); 2]; R];
        for p in 0..k {
            let from = b.add(p * COLUMNS);
            let (left, right) = (_mm256_loadu_ps(from), _mm256_loadu_ps(from.add(LANES)));
            // The same row of the next block. Prefetching past the end of the last one is harmless.
            _mm_prefetch::<_MM_HINT_T0>(from.wrapping_add(k * COLUMNS).cast());
            for (i, sum) in sums.iter_mut().enumerate() {
                let x = _mm256_broadcast_ss(&*a.add(i * k + p));
                sum[0] = _mm256_fmadd_ps(x, left, sum[0]);
                sum[1] = _mm256_fmadd_ps(x, right, sum[1]);
            }
        }
        for (i, sum) in sums.iter().enumerate() {
            _mm256_storeu_ps(c.add(i * c_row), sum[0]);
            _mm256_storeu_ps(c.add(i * c_row + LANES), sum[1]);
        }
    }
}

/// `c[m × n] = a[m × k] · b`, where `b` has `n / 16` consecutive blocks of `k × 16`.
///
/// # Safety
/// The CPU must have AVX2 and FMA, and the three matrices must span that many elements.
#[target_feature(enable = "avx2,fma")]
pub(crate) unsafe fn multiply_packed(
    m: usize,
    n: usize,
    k: usize,
    a: *const f32,
    b: *const f32,
    c: *mut f32,
) {
    let blocks = m.div_ceil(ROWS);
    for j in (0..n).step_by(COLUMNS) {
        // Blocks of nearly equal height: low ones have too few independent sums.
        for i in 0..blocks {
            let (from, to) = (i * m / blocks, (i + 1) * m / blocks);
            // SAFETY: rows from..to, at most `ROWS`, and the columns of block j are inside.
            unsafe {
                let (a, b, c) = (a.add(from * k), b.add(j * k), c.add(from * n + j));
                match to - from {
                    1 => block::<1>(k, a, b, c, n),
                    2 => block::<2>(k, a, b, c, n),
                    3 => block::<3>(k, a, b, c, n),
                    4 => block::<4>(k, a, b, c, n),
                    5 => block::<5>(k, a, b, c, n),
                    _ => block::<ROWS>(k, a, b, c, n),
                }
            }
        }
    }
}
