use quad_kernels::scaling::{Affine, Scaling};
use serde::{Deserialize, Serialize};

use crate::recording::{Recording, RowKind};
use crate::tables::reward::RewardScaling;

/// Columns to normalize before training. Files list them by name, in any order.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<Column>", into = "Vec<Column>")]
pub struct Normalize {
    /// Each action dimension, so that its minimum and maximum map to -1 and 1.
    pub actions: bool,
    /// Each observation dimension, to mean 0 and standard deviation 1.
    pub observations: bool,
    /// Rewards after the reward rule, to mean square 1.
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
    /// Offsets and scales for a recording of finite numbers. Statistics of observations and rewards
    /// are over transitions, those of actions also over dropped steps.
    pub(crate) fn scaling(self, recording: &Recording, rule: RewardScaling) -> Scaling {
        let Recording { observation_dim, action_dim, observations, actions, kinds, .. } = recording;
        let is_transition = |row: usize| kinds[row] == RowKind::Transition;
        let is_step = |row: usize| kinds[row] != RowKind::LastState;
        Scaling {
            observations: self
                .observations
                .then(|| affine(observations, *observation_dim, is_transition, standard)),
            actions: self.actions.then(|| affine(actions, *action_dim, is_step, unit_range)),
            // All-zero rewards stay unscaled.
            rewards: self.rewards.then(|| rule.size(recording) as f32).filter(|size| *size > 0.0),
        }
    }
}

pub(crate) fn standard_units(
    values: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool,
) -> Affine {
    affine(values, width, counts, standard)
}

pub(crate) fn apply(scaling: &Scaling, recording: &mut Recording) {
    if let Some(affine) = &scaling.observations {
        affine.to_network(&mut recording.observations);
        affine.to_network(recording.next_observations.as_deref_mut().unwrap_or_default());
    }
    if let Some(affine) = &scaling.actions {
        affine.to_network(&mut recording.actions);
    }
}

/// Map of each column by the offset and scale that `of` computes from the rows that count.
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
        // The scale is 0 if the column is constant in float32.
        (offset as f32, scale as f32)
    };
    let (offset, scale) = (0..width).map(column).unzip();
    Affine { offset, scale }
}

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

fn unit_range(values: &[f64]) -> (f64, f64) {
    let (min, max) = range(values);
    ((min + max) / 2.0, (max - min) / 2.0)
}

fn range(values: &[f64]) -> (f64, f64) {
    values
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(min, max), &x| (x.min(min), x.max(max)))
}
