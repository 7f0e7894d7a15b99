//! Conversion between a user's units and those of networks: an affine map of each number of an
//! observation or action, and a factor of rewards. Training and policies share this arithmetic.

use serde::{Deserialize, Serialize};

/// The maps of a policy and its data; `None` where both units are the same.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    /// Map of observations.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observations: Option<Affine>,
    /// Map of actions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actions: Option<Affine>,
    /// The user's reward for a reward of 1 in training; critics' values have the same unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rewards: Option<f32>,
}

/// user's = offset + scale · network's, column by column.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Affine {
    /// Offset of each column.
    pub offset: Vec<f32>,
    /// Scale of each column; 0 for a constant, of which the network sees 0 and the user the offset.
    pub scale: Vec<f32>,
}

impl Affine {
    /// True for a map of this many columns with finite numbers and no scale below 0.
    pub fn is_usable(&self, columns: usize) -> bool {
        let fits = (self.offset.len(), self.scale.len()) == (columns, columns);
        let mut numbers = self.offset.iter().chain(&self.scale);
        fits && numbers.all(|x| x.is_finite()) && self.scale.iter().all(|scale| *scale >= 0.0)
    }

    /// Converts `rows × columns` numbers to the network's units, in place.
    pub fn to_network(&self, numbers: &mut [f32]) {
        self.change(numbers, |x, offset, scale| match scale {
            0.0 => 0.0,
            _ => (x - offset) / scale,
        });
    }

    /// Converts `rows × columns` numbers to the user's units, in place.
    pub fn to_user(&self, numbers: &mut [f32]) {
        self.change(numbers, |x, offset, scale| offset + scale * x);
    }

    /// Computes in f64 to keep the digits beside a large offset.
    fn change(&self, numbers: &mut [f32], with: impl Fn(f64, f64, f64) -> f64) {
        let columns = self.offset.iter().zip(&self.scale).cycle();
        for (x, (offset, scale)) in numbers.iter_mut().zip(columns) {
            *x = with(f64::from(*x), f64::from(*offset), f64::from(*scale)) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn affine(offset: &[f32], scale: &[f32]) -> Affine {
        let (offset, scale) = (offset.to_vec(), scale.to_vec());
        Affine { offset, scale }
    }

    #[test]
    fn maps_that_lose_numbers_are_not_usable() {
        for scale in [-1.0, f32::NAN, f32::INFINITY] {
            assert!(!affine(&[0.0], &[scale]).is_usable(1), "{scale}");
        }
        assert!(!affine(&[f32::NAN], &[1.0]).is_usable(1));
    }

    #[test]
    fn a_constant_is_kept_exactly() {
        let affine = affine(&[0.1, 3.0], &[0.0, 2.0]);
        assert!(affine.is_usable(2));
        let mut numbers = [-0.048, 0.5];
        affine.to_user(&mut numbers);
        assert_eq!(numbers, [0.1, 4.0]);
        affine.to_network(&mut numbers);
        assert_eq!(numbers, [0.0, 0.5]);
        numbers[0] = 7.0;
        affine.to_network(&mut numbers[..1]);
        assert_eq!(numbers[0], 0.0);
    }
}
