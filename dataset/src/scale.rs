//! What networks see of observations, actions and rewards: a recording's own numbers, or these
//! scaled by what the data holds.

use quad_kernels::scaling::{Affine, Scaling};
use serde::{Deserialize, Serialize};

use crate::recording::{Recording, RowKind};
use crate::reward::RewardScaling;

/// What is scaled before training; a file has it as a list of [`Scaled`], in any order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<Scaled>", into = "Vec<Scaled>")]
pub struct Scale {
    /// Each number of an action, so that the least and the largest of the data become -1 and 1.
    pub actions: bool,
    /// Each number of an observation, so that those of the data have mean 0 and standard deviation
    /// 1.
    pub states: bool,
    /// Rewards, so that the mean of their squares is 1 after the reward rule.
    pub rewards: bool,
}

/// What can be scaled, by its name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scaled {
    /// Actions.
    Actions,
    /// Observations.
    States,
    /// Rewards.
    Rewards,
}

impl From<Vec<Scaled>> for Scale {
    fn from(names: Vec<Scaled>) -> Self {
        let has = |name| names.contains(&name);
        Self {
            actions: has(Scaled::Actions),
            states: has(Scaled::States),
            rewards: has(Scaled::Rewards),
        }
    }
}

impl From<Scale> for Vec<Scaled> {
    fn from(Scale { actions, states, rewards }: Scale) -> Self {
        [(actions, Scaled::Actions), (states, Scaled::States), (rewards, Scaled::Rewards)]
            .into_iter()
            .filter_map(|(is, name)| is.then_some(name))
            .collect()
    }
}

impl Scale {
    /// The maps for a recording whose numbers are finite. Observations count where a transition
    /// begins, actions wherever one was taken, rewards where there is a transition.
    pub(crate) fn of(self, recording: &Recording, rule: RewardScaling) -> Scaling {
        let Recording { observation_dim, action_dim, observations, actions, kinds, .. } = recording;
        let is_transition = |row: usize| kinds[row] == RowKind::Transition;
        let is_step = |row: usize| kinds[row] != RowKind::LastState;
        Scaling {
            observations: self
                .states
                .then(|| affine(observations, *observation_dim, is_transition, standard)),
            actions: self.actions.then(|| affine(actions, *action_dim, is_step, unit_range)),
            // Rewards that are all 0 have no size.
            rewards: self.rewards.then(|| rule.size(recording) as f32).filter(|size| *size > 0.0),
        }
    }
}

/// The map with which each column of these numbers has mean 0 and standard deviation 1 over the
/// rows that count.
pub(crate) fn standard_units(
    values: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool,
) -> Affine {
    affine(values, width, counts, standard)
}

/// Scales a recording.
pub(crate) fn apply(scaling: &Scaling, recording: &mut Recording) {
    if let Some(affine) = &scaling.observations {
        affine.to_network(&mut recording.observations);
        affine.to_network(recording.next_observations.as_deref_mut().unwrap_or_default());
    }
    if let Some(affine) = &scaling.actions {
        affine.to_network(&mut recording.actions);
    }
}

/// The map of each column, by the offset and the scale that `of` finds for its numbers in the rows
/// that count.
fn affine(
    values: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool,
    of: fn(&[f64]) -> (f64, f64),
) -> Affine {
    let column = |column: usize| {
        let values = values.iter().skip(column).step_by(width).enumerate();
        let values: Vec<f64> =
            values.filter(|(row, _)| counts(*row)).map(|(_, value)| f64::from(*value)).collect();
        let (offset, scale) = of(&values);
        // The scale is 0 where all are the same, or differ by less than a float32 can say.
        (offset as f32, scale as f32)
    };
    let (offset, scale) = (0..width).map(column).unzip();
    Affine { offset, scale }
}

/// Mean and standard deviation.
fn standard(values: &[f64]) -> (f64, f64) {
    let (least, largest) = range(values);
    if least == largest {
        return (least, 0.0); // By rounding, the deviation might not be 0.
    }
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

/// The middle of the range, and half its width.
fn unit_range(values: &[f64]) -> (f64, f64) {
    let (least, largest) = range(values);
    ((least + largest) / 2.0, (largest - least) / 2.0)
}

/// The least and the largest.
fn range(values: &[f64]) -> (f64, f64) {
    values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(least, largest), &x| {
        (x.min(least), x.max(largest))
    })
}
