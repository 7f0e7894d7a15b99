//! The product with its operands rounded to bfloat16 and its sums in f32.

use super::{Ahead, COLUMNS, LANES, Line, Pair, ROWS, Strided, amx, has_bf16};
use std::arch::x86_64::{
    __cpuid, __m512bh, __m512i, _MM_HINT_T0, _mm_prefetch, _mm512_cvtne2ps_pbh, _mm512_dpbf16_ps,
    _mm512_loadu_ps, _mm512_loadu_si512, _mm512_permutexvar_epi16, _mm512_set1_epi32,
    _mm512_setzero_ps, _mm512_store_si512, _mm512_storeu_ps,
};
use std::cell::RefCell;

/// True if this CPU multiplies so, and faster than in f32: by AMX, or by AVX512-BF16, which nearly
/// doubles the speed of AMD's CPUs but is slower than f32 on Intel's (0.6 times, where it was
/// measured).
pub(crate) fn available() -> bool {
    const INTEL: [u32; 3] =
        [u32::from_le_bytes(*b"Genu"), u32::from_le_bytes(*b"ineI"), u32::from_le_bytes(*b"ntel")];
    let vendor = __cpuid(0);
    amx::available() || has_bf16() && [vendor.ebx, vendor.edx, vendor.ecx] != INTEL
}

/// Name of the instructions in use: AMX or AVX-512.
pub(crate) fn instructions() -> &'static str {
    if amx::available() { "amx" } else { "avx512" }
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
    /// Rounded rows.
    static ROUNDED: RefCell<Vec<Line<Pair>>> = RefCell::default();
}

/// The right-hand side of products, `k × n`, rounded to bfloat16: block after block of columns, and
/// in each the pairs of `k` as rows.
pub(crate) struct Rounded {
    blocks: Vec<Line<Pair>>,
    k: usize,
    n: usize,
}

impl Rounded {
    /// Rounds a row-major matrix; `None` where this CPU cannot multiply with it, or it is not made
    /// of whole registers.
    pub fn new(matrix: &[f32], k: usize, n: usize) -> Option<Self> {
        assert_eq!(matrix.len(), k * n, "the matrix's shape");
        let whole = k.is_multiple_of(COLUMNS) && n.is_multiple_of(COLUMNS);
        // SAFETY: what it asks for holds.
        (whole && available()).then(|| unsafe { Self::round(matrix, k, n) })
    }

    /// # Safety
    /// This CPU must be able to; both sides must be multiples of [`COLUMNS`] and the matrix of that
    /// size.
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn round(matrix: &[f32], k: usize, n: usize) -> Self {
        // Lane i of the lower half beside lane i of the upper one.
        let interleave: [u16; 2 * LANES] = std::array::from_fn(|i| (i / 2 + i % 2 * LANES) as u16);
        let mut blocks = Vec::with_capacity(k / 2 * n / LANES);
        for j in (0..n).step_by(COLUMNS) {
            for i in 0..k {
                // SAFETY: of the pairs' rows 2·(i/2) and the next, the left or right half of the
                // block's columns.
                blocks.push(unsafe {
                    let from = matrix.as_ptr().add(i / 2 * 2 * n + j + i % 2 * LANES);
                    let row = _mm512_permutexvar_epi16(
                        _mm512_loadu_si512(interleave.as_ptr().cast()),
                        round(from, from.add(n)),
                    );
                    std::mem::transmute::<__m512i, Line<Pair>>(row)
                });
            }
        }
        Self { blocks, k, n }
    }

    /// `c[m × n] = a[m × k] · self`, `a` rounded too; row-major, by AMX where the CPU has it.
    pub fn product(&self, a: &[f32], c: &mut [f32]) {
        let m = a.len() / self.k;
        assert!(a.len() == m * self.k && c.len() == m * self.n, "the product's shape");
        // SAFETY: one is only made where the CPU can; the shapes were checked here and there.
        unsafe { self.multiply_by(amx::available(), m, a.as_ptr(), c.as_mut_ptr()) };
    }

    /// # Safety
    /// `a` and `c` must have `m` rows; tiles must be available where they are asked for.
    #[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
    unsafe fn multiply_by(&self, tiles: bool, m: usize, a: *const f32, c: *mut f32) {
        let (pairs, n) = (self.k / 2, self.n);
        let mut rounded = ROUNDED.take();
        rounded.resize(m * pairs / LANES, Line([0; LANES]));
        // SAFETY: m × k is a multiple of two registers, and whole blocks of pairs × 32 are behind
        // each other.
        unsafe {
            for (i, to) in rounded.iter_mut().enumerate() {
                let from = a.add(i * COLUMNS);
                _mm512_store_si512(to.0.as_mut_ptr().cast(), round(from, from.add(LANES)));
            }
            let a = Strided { first: rounded.as_ptr().cast(), row: pairs, column: 1 };
            let b: *const Pair = self.blocks.as_ptr().cast();
            if tiles {
                amx::multiply(m, n, pairs, a, b, c);
            } else {
                for j in (0..n).step_by(COLUMNS) {
                    let block = b.add(j * pairs);
                    let ahead = Ahead { first: block.wrapping_add(pairs * COLUMNS), row: COLUMNS };
                    panel(m, pairs, a, block, ahead, c.add(j), n);
                }
            }
        }
        ROUNDED.set(rounded);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// The dispatched product is tested beside the others in `product`; this is about the one that
    /// is not chosen there.
    #[test]
    fn tiles_add_up_what_registers_do() {
        if !amx::available() {
            return;
        }
        let mut generator = ChaCha8Rng::seed_from_u64(0);
        let mut numbers =
            |len: usize| (0..len).map(|_| generator.random_range(-1.0..1.0)).collect::<Vec<f32>>();
        for (m, k, n) in
            [(1, 32, 32), (2, 64, 96), (16, 32, 32), (17, 32, 64), (33, 96, 32), (100, 256, 64)]
        {
            let (a, b) = (numbers(m * k), numbers(k * n));
            let right = Rounded::new(&b, k, n).unwrap();
            let by = |tiles| {
                let mut c = vec![f32::NAN; m * n];
                // SAFETY: AMX was found; a and c have m rows.
                unsafe { right.multiply_by(tiles, m, a.as_ptr(), c.as_mut_ptr()) };
                c
            };
            for (i, (x, y)) in by(true).into_iter().zip(by(false)).enumerate() {
                assert!((x - y).abs() < 1e-5, "{m} × {k} × {n} at {i}: {x} for {y}");
            }
        }
    }
}
