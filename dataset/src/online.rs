//! Online episodes, and those that are left out: a number far outside the dataset's range, such
//! as a sensor's 1e30, would end training.

use crate::error::{ArrayProblem, Problem};
use crate::recording::{Names, Recording, RowKind, named};

/// Largest distance of a number from its column's range in the dataset, relative to its width.
const FAR: f64 = 1000.0;

/// An online episode of n steps, in the environment's units.
#[derive(Clone, Copy, Debug)]
pub struct OnlineEpisode<'a> {
    /// Observations from the first to the one after the last step, `(n + 1) × o`.
    pub observations: &'a [f32],
    /// Actions as they were taken, `n × a`.
    pub actions: &'a [f32],
    /// The environment's own rewards, `n`.
    pub rewards: &'a [f32],
    /// True if the last step terminated the task; else it was truncated.
    pub terminated: bool,
}

impl OnlineEpisode<'_> {
    /// n, if all arrays are of n ≥ 1 steps.
    pub(crate) fn steps(&self, o: usize, a: usize) -> Result<usize, Problem> {
        let n = self.rewards.len();
        let arrays =
            [("observations", self.observations, n + 1, o), ("actions", self.actions, n, a)];
        for (array, numbers, rows, width) in arrays {
            if numbers.len() != rows * width {
                return Err(ArrayProblem::Shape(vec![numbers.len()], [rows, width]).of(array));
            }
        }
        if n == 0 { Err(Problem::NoTransitions(0)) } else { Ok(n) }
    }

    /// The steps and the last state as n + 1 rows.
    pub(crate) fn recording(&self, o: usize, a: usize) -> Result<Recording, Problem> {
        let n = self.steps(o, a)?;
        let only_last = |flag: bool| Vec::from_iter((1..=n).map(|step| flag && step == n));
        let mut recording = Recording {
            observation_dim: o,
            action_dim: a,
            observations: self.observations.to_vec(),
            actions: self.actions.to_vec(),
            rewards: self.rewards.to_vec(),
            kinds: vec![RowKind::Transition; n],
            terminals: only_last(self.terminated),
            timeouts: vec![false; n],
            ends: only_last(true),
            ..Recording::default()
        };
        recording.push_last_state();
        Ok(recording)
    }
}

/// Smallest and largest number of a column.
type Range = [f32; 2];

/// Ranges of a dataset's columns.
pub(crate) struct Ranges {
    observations: Vec<Range>,
    actions: Vec<Range>,
    rewards: Vec<Range>,
}

impl Ranges {
    /// The ranges of a recording of finite numbers that is not scaled yet.
    pub(crate) fn new(recording: &Recording) -> Self {
        let Recording { observation_dim, action_dim, observations, actions, rewards, .. } =
            recording;
        let is_step = |row| recording.is_step(row);
        Self {
            observations: ranges(observations, *observation_dim, |_| true),
            actions: ranges(actions, *action_dim, is_step),
            rewards: ranges(rewards, 1, is_step),
        }
    }

    /// The first number of an episode further from the range of its column than [`FAR`] times its
    /// width, if any, in words. A row of observations comes before the step of that number.
    pub(crate) fn far(&self, episode: &OnlineEpisode<'_>, names: &Names) -> Option<String> {
        [
            ("observations", episode.observations, &self.observations, &*names.observations),
            ("actions", episode.actions, &self.actions, &*names.actions),
            ("rewards", episode.rewards, &self.rewards, &[]),
        ]
        .into_iter()
        .find_map(|(array, numbers, ranges, names)| {
            let far = |index: usize| is_far(ranges[index % ranges.len()], numbers[index]);
            let index = (0..numbers.len()).find(|index| far(*index))?;
            let (row, column) = (index / ranges.len(), index % ranges.len());
            let (value, [low, high]) = (numbers[index], ranges[column]);
            Some(format!(
                "array `{array}`, row {row}, {}: {value:e}, far outside the dataset's range of {low} to {high}",
                named(&[column], names)
            ))
        })
    }
}

fn ranges(values: &[f32], width: usize, counts: impl Fn(usize) -> bool) -> Vec<Range> {
    let mut ranges = vec![[f32::INFINITY, f32::NEG_INFINITY]; width];
    for (_, values) in values.chunks_exact(width.max(1)).enumerate().filter(|(row, _)| counts(*row))
    {
        for (range, &value) in ranges.iter_mut().zip(values) {
            *range = [range[0].min(value), range[1].max(value)];
        }
    }
    ranges
}

/// A range that is narrower than a thousandth of its numbers' size, or of 1, counts as this size:
/// what hardly moved in the data may move online.
fn is_far(range: Range, value: f32) -> bool {
    let ([low, high], value) = (range.map(f64::from), f64::from(value));
    let size = low.abs().max(high.abs()).max(1.0);
    let width = if high - low > size / FAR { high - low } else { size };
    (low - value).max(value - high) > FAR * width
}
