//! Normalization of observations, actions and rewards.

use quad_kernels::scaling::{Affine, Scaling};
use serde::{Deserialize, Serialize};

use crate::recording::{Recording, RowKind};
use crate::statistics::{Range, Summary};
use crate::tables::reward::RewardScaling;

/// Standard deviation of float32's last bit, relative to the number.
const ROUNDING: f64 = 1e-7;

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
        let has = |column| columns.contains(&column);
        Self {
            actions: has(Column::Actions),
            observations: has(Column::Observations),
            rewards: has(Column::Rewards),
        }
    }
}

impl From<Normalize> for Vec<Column> {
    fn from(normalize: Normalize) -> Self {
        let mut columns = Vec::new();
        columns.extend(normalize.actions.then_some(Column::Actions));
        columns.extend(normalize.observations.then_some(Column::Observations));
        columns.extend(normalize.rewards.then_some(Column::Rewards));
        columns
    }
}

impl Normalize {
    /// Offsets and scales for a recording of finite numbers. Statistics of observations and rewards
    /// are over transitions, those of actions also over dropped steps.
    pub(crate) fn scaling(self, recording: &Recording, rule: RewardScaling) -> Scaling {
        let (o, a) = (recording.observation_dim, recording.action_dim);
        let is_transition = |row: usize| recording.kinds[row] == RowKind::Transition;
        let is_step = |row: usize| recording.is_step(row);
        let states = || standard_units(&recording.observations, o, is_transition);
        let actions = || unit_ranges(&Range::columns(&recording.actions, a, is_step));
        let rms = self.rewards.then(|| rule.rms(recording) as f32);
        Scaling {
            observations: self.observations.then(states),
            actions: self.actions.then(actions),
            // All-zero rewards stay unscaled.
            rewards: rms.filter(|rms| *rms > 0.0),
        }
    }
}

pub(crate) fn apply(scaling: &Scaling, recording: &mut Recording) {
    if let Some(affine) = &scaling.observations {
        affine.to_network(&mut recording.observations);
        let next = recording.next_observations.as_deref_mut();
        affine.to_network(next.unwrap_or_default());
    }
    if let Some(affine) = &scaling.actions {
        affine.to_network(&mut recording.actions);
    }
}

/// Map of each column to mean 0 and standard deviation 1 in the rows that count. A column that is
/// constant but for [`ROUNDING`] has scale 0, else a robot that moves it would be far off its data.
pub(crate) fn standard_units(
    values: &[f32],
    width: usize,
    counts: impl Fn(usize) -> bool,
) -> Affine {
    let map = |summary: &Summary| match summary.deviation <= ROUNDING * summary.rms {
        true => (summary.min as f32, 0.0),
        false => (summary.mean as f32, summary.deviation as f32),
    };
    let columns = Summary::columns(values, width, counts);
    let (offset, scale) = columns.iter().map(map).unzip();
    Affine { offset, scale }
}

/// Map of each column from its range to [-1, 1].
fn unit_ranges(ranges: &[Range]) -> Affine {
    let map = |Range { min, max }: &Range| (((min + max) / 2.0) as f32, ((max - min) / 2.0) as f32);
    let (offset, scale) = ranges.iter().map(map).unzip();
    Affine { offset, scale }
}
