//! Dense products for CPUs with AVX-512.
//!
//! The matrices of these networks fit into a core's own cache, where a general library's copies of
//! both sides cost more than they gain (benches/README.md). Only one block of columns of the right
//! side at a time is copied or transposed, into the nearest cache.

use std::arch::x86_64::{
    __m512, _MM_HINT_T0, _mm_prefetch, _mm512_castpd_ps, _mm512_castps_pd, _mm512_fmadd_ps,
    _mm512_loadu_ps, _mm512_set1_ps, _mm512_setzero_ps, _mm512_shuffle_f32x4, _mm512_store_ps,
    _mm512_storeu_ps, _mm512_unpackhi_pd, _mm512_unpackhi_ps, _mm512_unpacklo_pd,
    _mm512_unpacklo_ps,
};
use std::cell::RefCell;

use crate::level::Level;

pub(crate) const LANES: usize = 16;
/// Columns of a block of the result: two registers.
pub(crate) const COLUMNS: usize = 2 * LANES;
/// Rows of a block of the result: its sums fill most of the 32 registers.
const ROWS: usize = 12;

/// True if this CPU has AVX-512 and results of this many columns are whole blocks.
pub(crate) fn serves(columns: usize) -> bool {
    columns.is_multiple_of(COLUMNS) && Level::in_use() == Level::Avx512
}

/// A register's numbers in one cache line; at other addresses an access takes two lines.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub(crate) struct Line<T>(pub [T; LANES]);

/// A matrix by its first element and the distances between rows and between columns.
#[derive(Clone, Copy)]
pub(crate) struct Strided<T> {
    pub first: *const T,
    pub row: usize,
    pub column: usize,
}

impl<T> Strided<T> {
    /// A matrix whose rows are contiguous, `row` elements apart.
    pub fn row_major(first: *const T, row: usize) -> Self {
        let column = 1;
        Self { first, row, column }
    }
}

/// Two neighboring terms of a sum, rounded to bfloat16.
type Pair = i32;

fn has_bf16() -> bool {
    Level::in_use() == Level::Avx512 && is_x86_feature_detected!("avx512bf16")
}

thread_local! {
    /// A block of columns of the right side.
    static BLOCK: RefCell<Vec<Line<f32>>> = RefCell::default();
    /// A copy of the left side.
    static LEFT: RefCell<Vec<f32>> = RefCell::default();
}

/// Distance at which rows share few sets of a core's caches.
const CROWDED: usize = 512;

/// The left side `m × k` of a product, copied to `room` with a gap after each row if its rows would
/// evict each other from the cache.
///
/// # Safety
/// The matrix must span that many elements.
unsafe fn spread(m: usize, k: usize, a: Strided<f32>, room: &mut Vec<f32>) -> Strided<f32> {
    let apart = a.row.max(a.column);
    if !apart.is_multiple_of(CROWDED) {
        return a;
    }
    let (rows, columns) = if a.column == 1 { (m, k) } else { (k, m) };
    let wider = columns + LANES;
    room.resize(rows * wider, 0.0);
    for (i, row) in room.chunks_exact_mut(wider).enumerate() {
        // SAFETY: row i of the matrix as it lies in memory.
        row[..columns].copy_from_slice(unsafe {
            std::slice::from_raw_parts(a.first.add(i * apart), columns)
        });
    }
    let (row, column) = if a.column == 1 { (wider, 1) } else { (1, wider) };
    Strided { first: room.as_ptr(), row, column }
}

/// Memory that is read after a block, prefetched in steps of two cache lines.
#[derive(Clone, Copy)]
struct Ahead<T> {
    first: *const T,
    row: usize,
}

/// Defines `panel`: `c = a·b` for `m` rows and one block of columns, `b` being `k × 32`, for elements
/// of 32 bits. `$add(sum, x, b)` adds the products of two registers to a third.
macro_rules! panel {
    ($features:literal, $element:ty, $broadcast:expr, $load:expr, $add:expr) => {
        #[inline]
        #[target_feature(enable = $features)]
        unsafe fn block<const R: usize>(
            k: usize,
            a: Strided<$element>,
            b: *const $element,
            ahead: Ahead<$element>,
            c: *mut f32,
            c_row: usize,
        ) {
            // SAFETY: the caller of `panel` vouches for whole matrices; the block lies inside.
            unsafe {
                let mut sums = [[_mm512_setzero_ps(); 2]; R];
                for p in 0..k {
                    let b = b.add(p * COLUMNS);
                    let (left, right) = ($load(b), $load(b.add(LANES)));
                    // Prefetching past the end of the last block is harmless.
                    let soon = ahead.first.wrapping_add(p * ahead.row);
                    _mm_prefetch::<_MM_HINT_T0>(soon.cast());
                    _mm_prefetch::<_MM_HINT_T0>(soon.wrapping_add(LANES).cast());
                    for (i, sum) in sums.iter_mut().enumerate() {
                        let x = $broadcast(*a.first.add(i * a.row + p * a.column));
                        sum[0] = $add(sum[0], x, left);
                        sum[1] = $add(sum[1], x, right);
                    }
                }
                for (i, sum) in sums.iter().enumerate() {
                    _mm512_storeu_ps(c.add(i * c_row), sum[0]);
                    _mm512_storeu_ps(c.add(i * c_row + LANES), sum[1]);
                }
            }
        }

        #[target_feature(enable = $features)]
        unsafe fn panel(
            m: usize,
            k: usize,
            a: Strided<$element>,
            b: *const $element,
            ahead: Ahead<$element>,
            c: *mut f32,
            c_row: usize,
        ) {
            // Blocks of nearly equal height: low ones have too few independent sums.
            let blocks = m.div_ceil(ROWS);
            for i in 0..blocks {
                let (from, to) = (i * m / blocks, (i + 1) * m / blocks);
                // SAFETY: rows from..to are inside, and at most `ROWS`.
                unsafe {
                    let (a, c) =
                        (Strided { first: a.first.add(from * a.row), ..a }, c.add(from * c_row));
                    match to - from {
                        1 => block::<1>(k, a, b, ahead, c, c_row),
                        2 => block::<2>(k, a, b, ahead, c, c_row),
                        3 => block::<3>(k, a, b, ahead, c, c_row),
                        4 => block::<4>(k, a, b, ahead, c, c_row),
                        5 => block::<5>(k, a, b, ahead, c, c_row),
                        6 => block::<6>(k, a, b, ahead, c, c_row),
                        7 => block::<7>(k, a, b, ahead, c, c_row),
                        8 => block::<8>(k, a, b, ahead, c, c_row),
                        9 => block::<9>(k, a, b, ahead, c, c_row),
                        10 => block::<10>(k, a, b, ahead, c, c_row),
                        11 => block::<11>(k, a, b, ahead, c, c_row),
                        _ => block::<ROWS>(k, a, b, ahead, c, c_row),
                    }
                }
            }
        }
    };
}

mod amx;
pub(crate) mod bf16;

panel!("avx512f", f32, _mm512_set1_ps, _mm512_loadu_ps, |sum, x, b| _mm512_fmadd_ps(x, b, sum));

/// `c[m × n] = a[m × k] · b[k × n]`, `b` and `c` row-major.
///
/// # Safety
/// [`serves`] must hold for `n`, and the three matrices must span that many elements.
#[target_feature(enable = "avx512f")]
pub(crate) unsafe fn multiply(
    m: usize,
    n: usize,
    k: usize,
    a: Strided<f32>,
    b: *const f32,
    c: *mut f32,
) {
    let (mut block_of_b, mut left) = (BLOCK.take(), LEFT.take());
    // SAFETY: the caller's.
    let a = unsafe { spread(m, k, a, &mut left) };
    block_of_b.resize(k * COLUMNS / LANES, Line([0.0; LANES]));
    let block = block_of_b.as_mut_ptr().cast::<f32>();
    for j in (0..n).step_by(COLUMNS) {
        // SAFETY: columns j.. of the matrices the caller vouches for.
        unsafe {
            for p in 0..k {
                for half in [0, LANES] {
                    _mm512_store_ps(
                        block.add(p * COLUMNS + half),
                        _mm512_loadu_ps(b.add(p * n + j + half)),
                    );
                }
            }
            let ahead = Ahead { first: b.wrapping_add(j + COLUMNS), row: n };
            panel(m, k, a, block, ahead, c.add(j), n);
        }
    }
    BLOCK.set(block_of_b);
    LEFT.set(left);
}

/// `c[m × n] = a[m × k] · b`, where `b` has `n / 32` consecutive blocks of `k × 32`.
///
/// # Safety
/// [`serves`] must hold for `n`, and the three matrices must span that many elements.
#[target_feature(enable = "avx512f")]
pub(crate) unsafe fn multiply_packed(
    m: usize,
    n: usize,
    k: usize,
    a: *const f32,
    b: *const f32,
    c: *mut f32,
) {
    let a = Strided::row_major(a, k);
    for j in (0..n).step_by(COLUMNS) {
        // SAFETY: block j and its columns of the result are inside.
        unsafe {
            let block = b.add(j * k);
            let ahead = Ahead { first: block.wrapping_add(k * COLUMNS), row: COLUMNS };
            panel(m, k, a, block, ahead, c.add(j), n);
        }
    }
}

/// Loads 16 rows of 16 numbers.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn load_square(from: *const f32, row: usize) -> [__m512; LANES] {
    let mut rows = [_mm512_setzero_ps(); LANES];
    for (i, register) in rows.iter_mut().enumerate() {
        // SAFETY: the caller vouches for 16 rows of 16.
        *register = unsafe { _mm512_loadu_ps(from.add(i * row)) };
    }
    rows
}

/// Stores the transpose of 16 × 16 elements.
#[inline]
#[target_feature(enable = "avx512f")]
unsafe fn store_transposed(rows: [__m512; LANES], to: *mut f32, to_row: usize) {
    // Quarter q of `quads[4·g + c]` is column 4·q + c of the rows 4·g..4·g + 4.
    let mut quads = rows;
    for g in (0..LANES).step_by(4) {
        let low = _mm512_castps_pd(_mm512_unpacklo_ps(rows[g], rows[g + 1]));
        let high = _mm512_castps_pd(_mm512_unpackhi_ps(rows[g], rows[g + 1]));
        let next_low = _mm512_castps_pd(_mm512_unpacklo_ps(rows[g + 2], rows[g + 3]));
        let next_high = _mm512_castps_pd(_mm512_unpackhi_ps(rows[g + 2], rows[g + 3]));
        quads[g] = _mm512_castpd_ps(_mm512_unpacklo_pd(low, next_low));
        quads[g + 1] = _mm512_castpd_ps(_mm512_unpackhi_pd(low, next_low));
        quads[g + 2] = _mm512_castpd_ps(_mm512_unpacklo_pd(high, next_high));
        quads[g + 3] = _mm512_castpd_ps(_mm512_unpackhi_pd(high, next_high));
    }
    const EVEN: i32 = 0b10_00_10_00;
    const ODD: i32 = 0b11_01_11_01;
    for c in 0..4 {
        let even = _mm512_shuffle_f32x4::<EVEN>(quads[c], quads[c + 4]);
        let odd = _mm512_shuffle_f32x4::<ODD>(quads[c], quads[c + 4]);
        let next_even = _mm512_shuffle_f32x4::<EVEN>(quads[c + 8], quads[c + 12]);
        let next_odd = _mm512_shuffle_f32x4::<ODD>(quads[c + 8], quads[c + 12]);
        let columns = [
            _mm512_shuffle_f32x4::<EVEN>(even, next_even),
            _mm512_shuffle_f32x4::<EVEN>(odd, next_odd),
            _mm512_shuffle_f32x4::<ODD>(even, next_even),
            _mm512_shuffle_f32x4::<ODD>(odd, next_odd),
        ];
        for (q, column) in columns.into_iter().enumerate() {
            // SAFETY: the caller vouches for 16 rows of 16 to write to.
            unsafe { _mm512_storeu_ps(to.add((4 * q + c) * to_row), column) };
        }
    }
}

/// `c[m × k] = a[m × n] · b[k × n]ᵀ`, all row-major.
///
/// # Safety
/// [`serves`] must hold for `k` and `n`, and the three matrices must span that many elements.
#[target_feature(enable = "avx512f")]
pub(crate) unsafe fn multiply_transposed(
    m: usize,
    k: usize,
    n: usize,
    a: *const f32,
    b: *const f32,
    c: *mut f32,
) {
    let (mut block_of_b, mut left) = (BLOCK.take(), LEFT.take());
    block_of_b.resize(n * COLUMNS / LANES, Line([0.0; LANES]));
    let block = block_of_b.as_mut_ptr().cast::<f32>();
    // SAFETY: the caller's.
    let a = unsafe { spread(m, n, Strided::row_major(a, n), &mut left) };
    for j in (0..k).step_by(COLUMNS) {
        // SAFETY: rows j..j + 32 of `b` become the columns of a block, n × 32.
        unsafe {
            for p in (0..n).step_by(LANES) {
                for half in [0, LANES] {
                    let rows = load_square(b.add((j + half) * n + p), n);
                    store_transposed(rows, block.add(p * COLUMNS + half), COLUMNS);
                }
            }
            let ahead = Ahead { first: b.wrapping_add((j + COLUMNS) * n), row: COLUMNS };
            panel(m, n, a, block, ahead, c.add(j), k);
        }
    }
    BLOCK.set(block_of_b);
    LEFT.set(left);
}
