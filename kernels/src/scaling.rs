//! Between a user's units and those of networks: an affine map of each number of an observation or
//! an action, and a factor of rewards. Training scales its data by the same arithmetic by which the
//! policy scales what it is given.

use serde::{Deserialize, Serialize};

/// The maps of a policy and of its data. Where there is none, the units are the user's.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scaling {
    /// Map of observations.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub observations: Option<Affine>,
    /// Map of actions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub actions: Option<Affine>,
    /// What a reward of 1 is to the user that training saw; values that critics give are in the
    /// same unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rewards: Option<f32>,
}

/// user's = offset + scale · network's, column by column. The file of a policy has both as they are
/// here.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Affine {
    /// What a network's 0 is to the user, a number for each column.
    pub offset: Vec<f32>,
    /// What a network's 1 is to the user beyond that, as many; 0 for a number that never changes:
    /// the network sees 0, and the user gets the offset exactly.
    pub scale: Vec<f32>,
}

impl Affine {
    /// Whether it is a map of so many columns: all finite, no scale below 0.
    pub fn is_usable(&self, columns: usize) -> bool {
        let lengths = (self.offset.len(), self.scale.len()) == (columns, columns);
        let offsets = self.offset.iter().all(|offset| offset.is_finite());
        lengths && offsets && self.scale.iter().all(|scale| scale.is_finite() && *scale >= 0.0)
    }

    /// Maps the user's numbers to the network's, in place; `numbers` is `rows × columns`.
    pub fn to_network(&self, numbers: &mut [f32]) {
        self.change(
            numbers,
            |x, offset, scale| if scale == 0.0 { 0.0 } else { (x - offset) / scale },
        );
    }

    /// Maps the network's numbers to the user's, in place; `numbers` is `rows × columns`.
    pub fn to_user(&self, numbers: &mut [f32]) {
        self.change(numbers, |x, offset, scale| offset + scale * x);
    }

    /// Computes in f64, so that a large offset costs no digits.
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

    #[test]
    fn a_map_that_turns_or_loses_numbers_is_not_usable() {
        for scale in [-1.0, f32::NAN, f32::INFINITY] {
            assert!(!Affine { offset: vec![0.0], scale: vec![scale] }.is_usable(1), "{scale}");
        }
        assert!(!Affine { offset: vec![f32::NAN], scale: vec![1.0] }.is_usable(1));
    }

    #[test]
    fn a_number_that_never_changes_keeps_its_value_exactly() {
        let affine = Affine { offset: vec![0.1, 3.0], scale: vec![0.0, 2.0] };
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
