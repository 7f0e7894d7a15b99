//! The right-hand side of products, packed once for many of them.

use crate::avx2;
use crate::avx512::bf16::Rounded;
use crate::avx512::{self, LANES, Line};
use crate::level::Level;
use crate::precision::Precision;

/// A matrix `k × n` in blocks of columns, so that products copy nothing.
pub struct Packed(Blocks);

enum Blocks {
    F32 { lines: Vec<Line<f32>>, k: usize, n: usize },
    Bf16(Rounded),
}

impl Packed {
    /// Packs a row-major matrix, rounded where [`Precision::Bf16`] applies; `None` if this CPU gains
    /// nothing, or the matrix is not whole blocks.
    pub fn new(precision: Precision, matrix: &[f32], k: usize, n: usize) -> Option<Self> {
        assert_eq!(matrix.len(), k * n, "the matrix's shape");
        if precision == Precision::Bf16
            && let Some(rounded) = Rounded::new(matrix, k, n)
        {
            return Some(Self(Blocks::Bf16(rounded)));
        }
        let columns = match Level::in_use() {
            Level::Avx512 => avx512::COLUMNS,
            Level::Avx2 => avx2::COLUMNS,
            Level::Plain => return None,
        };
        if !n.is_multiple_of(columns) {
            return None;
        }
        let mut lines = Vec::with_capacity(k * n / LANES);
        for j in (0..n).step_by(columns) {
            for row in matrix.chunks_exact(n) {
                for numbers in row[j..j + columns].chunks_exact(LANES) {
                    let mut line = Line([0.0; LANES]);
                    line.0.copy_from_slice(numbers);
                    lines.push(line);
                }
            }
        }
        Some(Self(Blocks::F32 { lines, k, n }))
    }

    /// `c[m × n] = a[m × k] · self`, row-major.
    pub fn product(&self, a: &[f32], c: &mut [f32]) {
        match &self.0 {
            Blocks::Bf16(rounded) => rounded.product(a, c),
            Blocks::F32 { lines, k, n } => {
                let m = a.len() / k;
                assert!(a.len() == m * k && c.len() == m * n, "the product's shape");
                let (a, b, c) = (a.as_ptr(), lines.as_ptr().cast(), c.as_mut_ptr());
                // SAFETY: packed for the instructions in use; the shapes were checked.
                unsafe {
                    match Level::in_use() {
                        Level::Avx512 => avx512::multiply_packed(m, *n, *k, a, b, c),
                        _ => avx2::multiply_packed(m, *n, *k, a, b, c),
                    }
                }
            }
        }
    }
}
