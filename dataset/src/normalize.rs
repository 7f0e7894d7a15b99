//! Normalization of observations, actions and rewards by statistics of the data.

use quad_kernels::scaling::{Affine, Scaling};
use serde::{Deserialize, Serialize};

use crate::recording::{Recording, RowKind};
use crate::tables::reward::RewardScaling;

/// Data to be normalized before training. In files it is a list of names, in any order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<Column>", into = "Vec<Column>")]
pub struct Normalize {
    /// Each number of an action, so that its least and largest value become -1 and 1.
    pub actions: bool,
    /// Each number of an observation, to mean 0 and standard deviation 1.
    pub observations: bool,
    /// Rewards after the reward rule, to a mean square of 1.
    pub rewards: bool,
}

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Column {
    Actions,
    Observations,
    Rewards,
}

impl From<Vec<Column>> for Normalize {
    fn from(columns: Vec<Column>) -> Self {
        let [actions, observations, rewards] =
            [Column::Actions, Column::Observations, Column::Rewards]
                .map(|column| columns.contains(&column));
        Self { actions, observations, rewards }
    }
}

impl From<Normalize> for Vec<Column> {
    fn from(Normalize { actions, observations, rewards }: Normalize) -> Self {
        let columns = [
            (actions, Column::Actions),
            (observations, Column::Observations),
            (rewards, Column::Rewards),
        ];
        columns.into_iter().filter_map(|(is, column)| is.then_some(column)).collect()
    }
}

impl Normalize {
    /// Offsets and scales for a recording whose numbers are finite. Observations count where a
    /// transition begins, actions wherever one was taken, rewards where there is a transition.
    pub(crate) fn scaling(self, recording: &Recording, rule: RewardScaling) -> Scaling {
        let Recording { observation_dim, action_dim, observations, actions, kinds, .. } = recording;
        let is_transition = |row: usize| kinds[row] == RowKind::Transition;
        let is_step = |row: usize| kinds[row] != RowKind::LastState;
        Scaling {
            observations: self
                .observations
                .then(|| affine(observations, *observation_dim, is_transition, standard)),
            actions: self.actions.then(|| affine(actions, *action_dim, is_step, unit_range)),
            // Rewards that are all 0 have no size.
            rewards: self.rewards.then(|| rule.size(recording) as f32).filter(|size| *size > 0.0),
        }
    }
}

/// The map by which each column has mean 0 and standard deviation 1 over the rows that count.
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

/// The map of each column, whose offset and scale `of` finds from the rows that count.
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

/// Mean and standard deviation of a column.
fn standard(values: &[f64]) -> (f64, f64) {
    let (min, max) = range(values);
    if min == max {
        return (min, 0.0); // By rounding, the deviation might not be 0.
    }
    let count = values.len() as f64;
    let mean = values.iter().sum::<f64>() / count;
    let variance = values.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / count;
    (mean, variance.sqrt())
}

/// Middle and half width of a column's range.
fn unit_range(values: &[f64]) -> (f64, f64) {
    let (min, max) = range(values);
    ((min + max) / 2.0, (max - min) / 2.0)
}

fn range(values: &[f64]) -> (f64, f64) {
    values
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), &x| (x.min(min), x.max(max)))
}
