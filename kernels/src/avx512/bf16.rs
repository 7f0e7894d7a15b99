//! The product with its operands rounded to bfloat16 and its sums in f32.

use super::{Ahead, COLUMNS, LANES, Line, Pair, ROWS, Strided, amx, has_bf16};
use std::arch::x86_64::{
    __cpuid, __m512, __m512bh, __m512i, _MM_HINT_T0, _mm_prefetch, _mm512_cvtne2ps_pbh,
    _mm512_dpbf16_ps, _mm512_loadu_ps, _mm512_loadu_si512, _mm512_permutexvar_epi16,
    _mm512_set1_epi32, _mm512_setzero_ps, _mm512_setzero_si512, _mm512_store_si512,
    _mm512_storeu_ps,
};
use std::cell::RefCell;
use std::sync::LazyLock;

/// True if this CPU multiplies so, and faster than in f32: by AMX, or by AVX512-BF16, which nearly
/// doubles the speed of AMD's CPUs but is slower than f32 on Intel's (0.6 times, where it was
/// measured).
pub(crate) fn available() -> bool {
    // Under a hypervisor `cpuid` takes as long as a small product.
    static AVAILABLE: LazyLock<bool> = LazyLock::new(|| {
        const INTEL: [&[u8; 4]; 3] = [b"Genu", b"ineI", b"ntel"];
        let vendor = __cpuid(0);
        let vendor = [vendor.ebx, vendor.edx, vendor.ecx];
        amx::available() || has_bf16() && vendor != INTEL.map(|part| u32::from_le_bytes(*part))
    });
    *AVAILABLE
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

thread_local! {
    /// The left side of a product, rounded.
    static LEFT: RefCell<Vec<Line<Pair>>> = RefCell::default();
    /// A block of columns of the right side, rounded.
    static RIGHT: RefCell<Vec<Line<Pair>>> = RefCell::default();
}

/// Rounds two registers of numbers, the first in the low half of the result.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn round(low: *const f32, high: *const f32) -> __m512i {
    // SAFETY: the caller vouches for 16 numbers at each.
    unsafe { bits(_mm512_cvtne2ps_pbh(_mm512_loadu_ps(high), _mm512_loadu_ps(low))) }
}

/// Rounds two registers of numbers to pairs of one of each.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn pair_up(low: *const f32, high: *const f32) -> __m512i {
    const ORDER: [u16; 2 * LANES] = {
        let mut order = [0; 2 * LANES];
        let mut i = 0;
        while i < 2 * LANES {
            order[i] = (i / 2 + i % 2 * LANES) as u16;
            i += 1;
        }
        order
    };
    // SAFETY: the caller vouches for 16 numbers at each.
    unsafe { _mm512_permutexvar_epi16(_mm512_loadu_si512(ORDER.as_ptr().cast()), round(low, high)) }
}

/// Stores the transpose of 16 × 16 pairs.
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn store_transposed(rows: [__m512i; LANES], to: *mut Pair, to_row: usize) {
    // SAFETY: registers of any content; the caller vouches for 16 rows of 16 to write to.
    unsafe {
        let rows = std::mem::transmute::<[__m512i; LANES], [__m512; LANES]>(rows);
        super::store_transposed(rows, to.cast(), to_row);
    }
}

/// Rounds the left side of a product, `m × k`, to rows of pairs with a gap after each, since rows
/// at a distance of a power of two would evict each other from the cache.
///
/// # Safety
/// The matrix must span that many elements; `k` must be a multiple of [`COLUMNS`], and `m`, too,
/// where the columns are contiguous.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn round_left(
    m: usize,
    k: usize,
    a: Strided<f32>,
    room: &mut Vec<Line<Pair>>,
) -> Strided<Pair> {
    let row = k / 2 + LANES;
    room.resize(m * row / LANES, Line([0; LANES]));
    let to: *mut Pair = room.as_mut_ptr().cast();
    // SAFETY: the caller's.
    unsafe {
        if a.column == 1 {
            for i in 0..m {
                for p in (0..k / 2).step_by(LANES) {
                    let from = a.first.add(i * a.row + 2 * p);
                    _mm512_store_si512(to.add(i * row + p).cast(), round(from, from.add(LANES)));
                }
            }
        } else {
            for p in (0..k / 2).step_by(LANES) {
                for i in (0..m).step_by(LANES) {
                    let mut square = [_mm512_setzero_si512(); LANES];
                    for (q, row) in square.iter_mut().enumerate() {
                        let from = a.first.add(2 * (p + q) * a.column + i);
                        *row = pair_up(from, from.add(a.column));
                    }
                    store_transposed(square, to.add(i * row + p), row);
                }
            }
        }
    }
    Strided::row_major(to, row)
}

/// Rounds columns `j..j + 32` of the right side of a product, `k × n`, to rows of pairs.
///
/// # Safety
/// The columns must be inside, `k` be a multiple of [`COLUMNS`], and `to` have room for `k / 2` rows.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn round_right(k: usize, b: Strided<f32>, j: usize, to: *mut Pair) {
    // SAFETY: the caller's.
    unsafe {
        if b.column == 1 {
            for p in 0..k / 2 {
                for half in [0, LANES] {
                    let from = b.first.add(2 * p * b.row + j + half);
                    let to = to.add(p * COLUMNS + half);
                    _mm512_store_si512(to.cast(), pair_up(from, from.add(b.row)));
                }
            }
        } else {
            for p in (0..k / 2).step_by(LANES) {
                for half in [0, LANES] {
                    let mut square = [_mm512_setzero_si512(); LANES];
                    for (i, row) in square.iter_mut().enumerate() {
                        let from = b.first.add((j + half + i) * b.column + 2 * p);
                        *row = round(from, from.add(LANES));
                    }
                    store_transposed(square, to.add(p * COLUMNS + half), COLUMNS);
                }
            }
        }
    }
}

/// `c = a·b` for `m` rows and one block of columns, by AMX's `tiles` or by registers.
///
/// # Safety
/// As for `panel` and [`amx::panel`].
#[inline]
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
unsafe fn multiply_block(
    tiles: bool,
    (m, pairs): (usize, usize),
    a: Strided<Pair>,
    b: *const Pair,
    ahead: Ahead<Pair>,
    c: *mut f32,
    c_row: usize,
) {
    // SAFETY: the caller's.
    unsafe {
        match tiles {
            true => amx::panel(m, pairs, a, b, c, c_row),
            false => panel(m, pairs, a, b, ahead, c, c_row),
        }
    }
}

/// True if [`multiply`] computes such products: sums of whole registers of pairs, whole blocks of
/// columns, and a left side that need not be transposed, or has whole blocks of rows.
pub(crate) fn serves([m, k, n]: [usize; 3], a: Strided<f32>) -> bool {
    let whole = |size: usize| size.is_multiple_of(COLUMNS);
    whole(k) && whole(n) && (a.column == 1 || whole(m)) && available()
}

/// `c[m × n] = a[m × k] · b[k × n]`, both rounded; `c` row-major. Rows or columns of each side must
/// be contiguous.
///
/// # Safety
/// [`serves`] must hold, and the three matrices must span that many elements.
#[target_feature(enable = "avx512f,avx512bw,avx512bf16")]
pub(crate) unsafe fn multiply(
    [m, k, n]: [usize; 3],
    a: Strided<f32>,
    b: Strided<f32>,
    c: *mut f32,
) {
    let (mut left, mut right) = (LEFT.take(), RIGHT.take());
    right.resize(k * COLUMNS / (2 * LANES), Line([0; LANES]));
    let block: *mut Pair = right.as_mut_ptr().cast();
    // SAFETY: the caller's.
    unsafe {
        let (a, tiles) = (round_left(m, k, a, &mut left), amx::available());
        for j in (0..n).step_by(COLUMNS) {
            round_right(k, b, j, block);
            // A row of each pair, or every other line.
            let (next, row) = match b.column {
                1 => (b.first.wrapping_add(j + COLUMNS), 2 * b.row),
                _ => (b.first.wrapping_add((j + COLUMNS) * b.column), 2 * COLUMNS),
            };
            let ahead = Ahead { first: next.cast(), row };
            multiply_block(tiles, (m, k / 2), a, block, ahead, c.add(j), n);
        }
    }
    LEFT.set(left);
    RIGHT.set(right);
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
        let b = Strided::row_major(matrix.as_ptr(), n);
        if !serves([1, k, n], b) {
            return None;
        }
        let mut blocks = vec![Line([0; LANES]); k / 2 * n / LANES];
        for (i, block) in blocks.chunks_exact_mut(k * COLUMNS / (2 * LANES)).enumerate() {
            // SAFETY: the CPU can, both sides are multiples of `COLUMNS`, and the block is k / 2 rows.
            unsafe { round_right(k, b, i * COLUMNS, block.as_mut_ptr().cast()) };
        }
        Some(Self { blocks, k, n })
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
        let (pairs, n, mut left) = (self.k / 2, self.n, LEFT.take());
        // SAFETY: whole blocks of pairs × 32 are behind each other.
        unsafe {
            let a = round_left(m, self.k, Strided::row_major(a, self.k), &mut left);
            let b: *const Pair = self.blocks.as_ptr().cast();
            for j in (0..n).step_by(COLUMNS) {
                let block = b.add(j * pairs);
                let ahead = Ahead { first: block.wrapping_add(pairs * COLUMNS), row: COLUMNS };
                multiply_block(tiles, (m, pairs), a, block, ahead, c.add(j), n);
            }
        }
        LEFT.set(left);
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
            |len: usize| Vec::from_iter((0..len).map(|_| generator.random_range(-1.0..1.0f32)));
        for (m, k, n) in [(1, 32, 32), (2, 64, 96), (16, 32, 32), (17, 32, 64), (100, 256, 64)] {
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
