//! Whether one of two arrays of the same numbers was rounded, as to float16.

/// Bits of a float32 that are 0 where it was rounded to bfloat16 or float16, and the share of a
/// number by which that moves it.
const BINARY: [(u32, f32); 2] = [(0xffff, 1.0 / 256.0), (0x1fff, 1.0 / 2048.0)];
/// Decimals to which logs are rounded.
const DECIMALS: std::ops::RangeInclusive<i32> = 1..=6;
/// Slack for the second rounding, to float32.
const SLACK: f32 = 1.01;

/// How far rounding moves a number at most: by a share of itself, or by a distance.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Rounding {
    share: f32,
    distance: f32,
}

impl Rounding {
    /// What was done to one of two arrays and not to the other.
    pub(crate) fn between(one: &[f32], other: &[f32]) -> Self {
        let differ = |is_rounded: &dyn Fn(f32) -> bool| {
            one.iter().all(|x| is_rounded(*x)) != other.iter().all(|x| is_rounded(*x))
        };
        let binary = BINARY.iter().find(|(bits, _)| differ(&|x| x.to_bits() & bits == 0));
        if let Some((_, share)) = binary {
            return Self { share: share * SLACK, distance: 0.0 };
        }
        let decimal = DECIMALS.map(|decimals| 10_f64.powi(decimals)).find(|unit| {
            differ(&|x| {
                let scaled = f64::from(x) * unit;
                (scaled - scaled.round()).abs() <= scaled.abs() * f64::from(f32::EPSILON)
            })
        });
        Self { share: 0.0, distance: decimal.map_or(0.0, |unit| 0.5 / unit as f32 * SLACK) }
    }

    /// Whether rounding alone may have made these of one number.
    pub(crate) fn explains(self, one: f32, other: f32) -> bool {
        (one - other).abs() <= self.distance.max(self.share * one.abs().max(other.abs()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_that_was_rounded_is_told_from_one_that_was_not() {
        let exact: Vec<f32> = (1..200).map(|i| (i as f32).sin() * 3.0).collect();
        let half = |x: &f32| f32::from_bits((x.to_bits() + 0xfff) & !0x1fff);
        let brain = |x: &f32| f32::from_bits((x.to_bits() + 0x7fff) & !0xffff);
        let decimals = |x: &f32| (f64::from(*x) * 1e4).round() as f32 / 1e4;
        for rounded in [half, brain, decimals] {
            let rounded: Vec<f32> = exact.iter().map(rounded).collect();
            for rounding in
                [Rounding::between(&exact, &rounded), Rounding::between(&rounded, &exact)]
            {
                assert!(
                    exact.iter().zip(&rounded).all(|(x, y)| rounding.explains(*x, *y)),
                    "{rounding:?}"
                );
                assert!(!rounding.explains(1.0, 1.02));
            }
            assert_eq!(Rounding::between(&rounded, &rounded), Rounding::default());
        }
        assert_eq!(Rounding::between(&exact, &exact), Rounding::default());
        assert!(!Rounding::default().explains(1.0, 1.0 + f32::EPSILON));
    }
}
