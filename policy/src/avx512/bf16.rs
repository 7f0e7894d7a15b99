//! The product with its operands rounded to bfloat16 and its sums in f32: twice as fast where the CPU has AVX512-BF16.

use super::{COLUMNS, LANES, ROWS, Strided};
use std::arch::x86_64::{
    __m512bh, __m512i, _MM_HINT_T0, _mm_prefetch, _mm512_cvtne2ps_pbh, _mm512_dpbf16_ps, _mm512_loadu_ps,
    _mm512_loadu_si512, _mm512_permutexvar_epi16, _mm512_set1_epi32, _mm512_setzero_ps, _mm512_storeu_ps,
    _mm512_storeu_si512,
};
use std::cell::RefCell;

/// Two neighbours of a sum's terms in one element.
type Pair = i32;

/// Whether this CPU can, and a product of these shapes is made of whole registers.
pub(crate) fn serves(k: usize, columns: usize) -> bool {
    super::serves(columns) && k.is_multiple_of(COLUMNS) && available()
}

/// Whether this CPU can.
pub(crate) fn available() -> bool {
    is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512bf16")
}

#[inline]
fn pairs(x: __m512i) -> __m512bh {
    // SAFETY: both are 64 bytes of any content.
    unsafe { std::mem::transmute(x) }
}

#[inline]
fn bits(x: __m512bh) -> __m512i {
    // SAFETY: both are 64 bytes of any content.
    unsafe { std::mem::transmute(x) }
}

panel!(
    "avx512f,avx512bw,avx512bf16",
    Pair,
    _mm512_set1_epi32,
    |b: *const Pair| _mm512_loadu_si512(b.cast()),
    |sum, x, b| _mm512_dpbf16_ps(sum, pairs(x), pairs(b))
);

/// Rounds two registers of numbers, the first in the low half of the result.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn round(low: *const f32, high: *const f32) -> __m512i {
    // SAFETY: the caller vouches for 16 numbers at each.
    unsafe { bits(_mm512_cvtne2ps_pbh(_mm512_loadu_ps(high), _mm512_loadu_ps(low))) }
}

thread_local! {
    /// Rounded operands: all of `a`, and a block of columns of `b`.
    static ROUNDED: RefCell<[Vec<Pair>; 2]> = RefCell::default();
}

/// `c[m × n] = a[m × k] · b[k × n]`, all row-major.
///
/// # Safety
/// [`serves`] must hold for `k` and `n`, and the three matrices must span that many elements.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(crate) unsafe fn multiply(m: usize, n: usize, k: usize, a: *const f32, b: *const f32, c: *mut f32) {
    let pairs = k / 2;
    let [mut rounded_a, mut rounded_b] = ROUNDED.take();
    rounded_a.resize(m * pairs, 0);
    rounded_b.resize(pairs * COLUMNS, 0);
    // Lane i of the lower half beside lane i of the upper one.
    let interleave: [u16; 2 * LANES] = std::array::from_fn(|i| (i / 2 + i % 2 * LANES) as u16);
    // SAFETY: m × k is a multiple of two registers, a block of `b` is k rows of two.
    unsafe {
        let interleave = _mm512_loadu_si512(interleave.as_ptr().cast());
        for (i, to) in rounded_a.chunks_exact_mut(LANES).enumerate() {
            let from = a.add(i * COLUMNS);
            _mm512_storeu_si512(to.as_mut_ptr().cast(), round(from, from.add(LANES)));
        }
        let a = Strided { first: rounded_a.as_ptr(), row: pairs, column: 1 };
        for j in (0..n).step_by(COLUMNS) {
            for (i, to) in rounded_b.chunks_exact_mut(LANES).enumerate() {
                let from = b.add(i / 2 * 2 * n + j + i % 2 * LANES);
                let row = _mm512_permutexvar_epi16(interleave, round(from, from.add(n)));
                _mm512_storeu_si512(to.as_mut_ptr().cast(), row);
            }
            panel(m, pairs, a, rounded_b.as_ptr(), COLUMNS, c.add(j), n);
        }
    }
    ROUNDED.set([rounded_a, rounded_b]);
}
