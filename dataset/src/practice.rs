//! Episodes of practice.

use crate::error::{ArrayProblem, Problem};
use crate::recording::{Recording, RowKind};

/// An episode of practice of n steps, in the environment's units.
#[derive(Clone, Copy, Debug)]
pub struct PracticeRows<'a> {
    /// Observations from the first to the one after the last step, `(n + 1) × o`.
    pub observations: &'a [f32],
    /// Actions as they were taken, `n × a`.
    pub actions: &'a [f32],
    /// The environment's own rewards, `n`.
    pub rewards: &'a [f32],
    /// True if the last step terminated the task; else it was truncated.
    pub terminated: bool,
}

impl PracticeRows<'_> {
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
