//! Arrays of which one was rounded to float16.

/// Low bits of a float32 that are 0 where it was rounded to float16.
const HALF: u32 = 0x1fff;
/// Relative distance by which that moves a number, with slack for the second rounding to float32.
const DISTANCE: f32 = 1.01 / 2048.0;

/// Tolerance between two arrays of the same numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Rounding {
    relative: f32,
}

impl Rounding {
    /// The tolerance where one of two arrays was rounded and the other was not; else none.
    pub(crate) fn between(one: &[f32], other: &[f32]) -> Self {
        let is_half = |values: &[f32]| values.iter().all(|x| x.to_bits() & HALF == 0);
        Self { relative: if is_half(one) != is_half(other) { DISTANCE } else { 0.0 } }
    }

    /// Whether rounding alone explains the difference of two numbers.
    pub(crate) fn explains(self, one: f32, other: f32) -> bool {
        (one - other).abs() <= self.relative * one.abs().max(other.abs())
    }
}
