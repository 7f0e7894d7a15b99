//! Online episodes, and those that are left out: a number far outside the dataset's range, such
//! as a sensor's 1e30, would end training.

use crate::error::{ArrayProblem, Problem};
use crate::recording::{Names, Recording, RowKind, named};
use crate::statistics::Range;

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
        let (observations, actions) = (self.observations.len(), self.actions.len());
        let (states, steps) = ([n + 1, o], [n, a]);
        for (array, length, shape) in
            [("observations", observations, states), ("actions", actions, steps)]
        {
            if length != shape[0] * shape[1] {
                return Err(ArrayProblem::Shape(vec![length], shape).in_array(array));
            }
        }
        match n {
            0 => Err(Problem::NoTransitions(0)),
            _ => Ok(n),
        }
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

/// Ranges of a dataset's columns; NaN without a dataset, from which nothing is far.
pub(crate) struct Ranges {
    observations: Vec<Range>,
    actions: Vec<Range>,
    rewards: Vec<Range>,
}

impl Ranges {
    /// The ranges of a recording of finite numbers that is not scaled yet.
    pub(crate) fn new(recording: &Recording) -> Self {
        let (o, a) = (recording.observation_dim, recording.action_dim);
        let is_step = |row| recording.is_step(row);
        Self {
            observations: Range::columns(&recording.observations, o, |_| true),
            actions: Range::columns(&recording.actions, a, is_step),
            rewards: Range::columns(&recording.rewards, 1, is_step),
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
            let Range { min, max } = ranges[column];
            Some(format!(
                "array `{array}`, row {row}, {}: {:e}, far outside the dataset's range of {} to {}",
                named(&[column], names),
                numbers[index],
                min as f32,
                max as f32
            ))
        })
    }
}

/// A range that is narrower than a thousandth of its numbers' size, or of 1, counts as this size:
/// what hardly moved in the data may move online.
fn is_far(range: Range, value: f32) -> bool {
    let (Range { min, max }, value) = (range, f64::from(value));
    let size = min.abs().max(max.abs()).max(1.0);
    let width = match max - min > size / FAR {
        true => max - min,
        false => size,
    };
    (min - value).max(value - max) > FAR * width
}
