//! Comparison of arrays of which one was rounded to float16.

/// Low bits of a float32 that are 0 after rounding to float16.
const HALF: u32 = 0x1fff;
/// Relative error of float16, with slack for the second rounding to float32.
const DISTANCE: f32 = 1.01 / 2048.0;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Rounding {
    relative: f32,
}

impl Rounding {
    /// Tolerance of float16 if there are two arrays of which one was rounded, else 0.
    pub(crate) fn between(one: &[f32], other: Option<&Vec<f32>>) -> Self {
        let is_half = |values: &[f32]| values.iter().all(|x| x.to_bits() & HALF == 0);
        let is_one = other.is_some_and(|other| is_half(one) != is_half(other));
        Self { relative: if is_one { DISTANCE } else { 0.0 } }
    }

    pub(crate) fn explains(self, one: f32, other: f32) -> bool {
        (one - other).abs() <= self.relative * one.abs().max(other.abs())
    }
}
