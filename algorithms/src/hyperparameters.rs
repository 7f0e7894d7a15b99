//! Types of hyper-parameters that check their range when they are read, and training phases whose
//! lengths they give in proportion to the run's.

use std::ops::Deref;

use quad_policy::Choice;
use serde::Deserialize;
use serde::de::{Deserializer, Error};

macro_rules! checked {
    ($(#[$meta:meta])* $name:ident($number:ty), $holds:expr, $range:literal) => {
        $(#[$meta])*
        #[derive(Clone, Copy, Debug, PartialEq)]
        pub(super) struct $name(pub $number);

        impl Deref for $name {
            type Target = $number;

            fn deref(&self) -> &$number {
                &self.0
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let value = <$number>::deserialize(deserializer)?;
                let holds: fn($number) -> bool = $holds;
                match holds(value) {
                    true => Ok(Self(value)),
                    false => Err(D::Error::custom(format_args!("{value} is not {}", $range))),
                }
            }
        }
    };
}

checked!(Finite(f32), |x| x.is_finite(), "finite");
checked!(Positive(f32), |x| x > 0.0 && x.is_finite(), "above 0 and finite");
checked!(NotNegative(f32), |x| x >= 0.0 && x.is_finite(), "at least 0 and finite");
checked!(
    /// Within [0, 1]: a discount or a factor.
    UnitInterval(f32), |x| (0.0..=1.0).contains(&x), "in [0, 1]"
);
checked!(
    /// Within (0, 1]: the rate of an average.
    Rate(f32), |x| x > 0.0 && x <= 1.0, "in (0, 1]"
);
checked!(OpenUnit(f32), |x| x > 0.0 && x < 1.0, "above 0 and below 1");
checked!(
    /// A number of things: networks, samples, denoising steps.
    Count(usize), |x| (1..=1000).contains(&x), "a whole number from 1 to 1000"
);
checked!(Steps(u64), |x| x > 0, "at least 1");

checked!(
    /// Actions that a policy draws in each state.
    Candidates(u32), |x| (1..=Choice::MOST_CANDIDATES).contains(&x), "a whole number from 1 to 10000"
);

/// The first step of each phase in a run of `total_steps`, for phases of these relative lengths.
pub(super) fn first_steps<const N: usize>(total_steps: u64, lengths: [Steps; N]) -> [u64; N] {
    let lengths = lengths.map(|length| u128::from(*length));
    let whole: u128 = lengths.iter().sum();
    std::array::from_fn(|phase| {
        (u128::from(total_steps) * lengths[..phase].iter().sum::<u128>() / whole) as u64
    })
}

/// The phase of a step, from 0, and the number of its steps before this one.
pub(super) fn phase(first_steps: &[u64], step: u64) -> (usize, u64) {
    let phase = first_steps.partition_point(|first| *first <= step) - 1;
    (phase, step - first_steps[phase])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_divide_a_run_of_any_length_in_proportion() {
        let lengths = [500_000, 2_000_000, 100_000].map(Steps);
        for (total_steps, expected) in
            [(2_600_000, [0, 500_000, 2_500_000]), (600, [0, 115, 576]), (1, [0, 0, 0])]
        {
            assert_eq!(first_steps(total_steps, lengths), expected);
        }
        assert_eq!([(0, 0), (1, 3), (2, 9)], [0, 118, 585].map(|step| phase(&[0, 115, 576], step)));
    }
}
