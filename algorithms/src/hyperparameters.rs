//! Types of hyper-parameters that check their range when they are read.

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
