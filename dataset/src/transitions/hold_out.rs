//! Validation episodes.

use std::ops::Range;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use crate::recording::{Recording, RowKind};

/// Distinguishes this random stream from others of the run's seed.
const PURPOSE: u64 = u64::from_be_bytes(*b"hold out");

/// Choice of validation episodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HoldOut<'a> {
    /// Random fraction of the episodes.
    Fraction {
        /// Fraction between 0 (none) and 1.
        fraction: f64,
        /// Seed of the choice.
        seed: u64,
    },
    /// Indices of episodes, from 0 in file order.
    Episodes(&'a [usize]),
}

impl HoldOut<'_> {
    pub(crate) const NONE: Self = Self::Episodes(&[]);

    pub(crate) fn is_none(self) -> bool {
        matches!(self, Self::Fraction { fraction: 0.0, .. } | Self::Episodes([]))
    }
}

/// Indices in ascending order. A fraction above 0 leaves at least one episode on each side.
pub(crate) fn chosen(hold_out: HoldOut<'_>, episodes: usize) -> Vec<usize> {
    let (fraction, seed) = match hold_out {
        HoldOut::Fraction { fraction, seed } => (fraction, seed),
        HoldOut::Episodes(numbers) => return numbers.to_vec(),
    };
    let mut numbers = Vec::from_iter(0..episodes);
    numbers.shuffle(&mut ChaCha8Rng::seed_from_u64(seed ^ PURPOSE));
    let count =
        if fraction > 0.0 { ((fraction * episodes as f64).round() as usize).max(1) } else { 0 };
    numbers.truncate(count.min(episodes.saturating_sub(1)));
    numbers.sort_unstable();
    numbers
}

impl Recording {
    fn rows_of_episodes(&self) -> Vec<Range<usize>> {
        let (mut episodes, mut start) = (Vec::new(), 0);
        for row in 0..self.rows() {
            let last_state_follows = self.kinds.get(row + 1) == Some(&RowKind::LastState);
            let ended = self.ends[row] || self.kinds[row] == RowKind::LastState;
            if (ended && !last_state_follows) || row + 1 == self.rows() {
                episodes.push(start..row + 1);
                start = row + 1;
            }
        }
        episodes
    }

    /// Training episodes, held-out episodes, and the indices of the latter.
    pub(crate) fn hold_out(&self, hold_out: HoldOut<'_>) -> (Recording, Recording, Vec<usize>) {
        let episodes = self.rows_of_episodes();
        let out = chosen(hold_out, episodes.len());
        let (mut training, mut held_out) = (self.like(), self.like());
        for (number, rows) in episodes.into_iter().enumerate() {
            let part =
                if out.binary_search(&number).is_ok() { &mut held_out } else { &mut training };
            part.extend(self, rows);
        }
        for part in [&mut training, &mut held_out] {
            part.close();
        }
        (training, held_out, out)
    }

    fn like(&self) -> Recording {
        let Recording { observation_dim, action_dim, goal, rounding, terminal_array, .. } = *self;
        let (names, next_observations) =
            (self.names.clone(), self.next_observations.as_ref().map(|_| Vec::new()));
        let sizes = Recording {
            observation_dim,
            action_dim,
            goal,
            rounding,
            terminal_array,
            ..Recording::default()
        };
        Recording { names, next_observations, ..sizes }
    }

    fn extend(&mut self, from: &Recording, rows: Range<usize>) {
        let (o, a) = (from.observation_dim, from.action_dim);
        let (of_observations, of_actions) =
            (rows.start * o..rows.end * o, rows.start * a..rows.end * a);
        self.observations.extend_from_slice(&from.observations[of_observations.clone()]);
        self.actions.extend_from_slice(&from.actions[of_actions]);
        self.rewards.extend_from_slice(&from.rewards[rows.clone()]);
        if let (Some(next), Some(from)) = (&mut self.next_observations, &from.next_observations) {
            next.extend_from_slice(&from[of_observations]);
        }
        self.kinds.extend_from_slice(&from.kinds[rows.clone()]);
        self.terminals.extend_from_slice(&from.terminals[rows.clone()]);
        self.timeouts.extend_from_slice(&from.timeouts[rows.clone()]);
        self.ends.extend_from_slice(&from.ends[rows]);
    }

    /// Appends a final state if the last row's next observation was in an episode that is removed.
    fn close(&mut self) {
        if self.kinds.last() != Some(&RowKind::Transition) || self.next_observations.is_some() {
            return;
        }
        let (last, o, a) = (self.rows() - 1, self.observation_dim, self.action_dim);
        self.observations.extend_from_within(last * o..);
        self.actions.extend_from_within(last * a..);
        self.rewards.push(0.0);
        self.kinds.push(RowKind::LastState);
        self.terminals.push(false);
        self.timeouts.push(false);
        self.ends.push(false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::tests::recording;

    #[test]
    fn episodes_are_kept_out_whole() {
        use RowKind::{Dropped, LastState, Transition};
        let mut whole = recording(&[
            Transition, Transition, Transition, Dropped, Transition, LastState, Transition,
        ]);
        (whole.ends[1], whole.terminals[1], whole.ends[3]) = (true, true, true);
        assert_eq!(whole.rows_of_episodes(), [0..2, 2..4, 4..6, 6..7]);
        let (mut seen, hold_out) = (Vec::new(), |seed| HoldOut::Fraction { fraction: 0.25, seed });
        for seed in 0..20 {
            let (training, held_out, out) = whole.hold_out(hold_out(seed));
            assert_eq!(out.len(), 1);
            let rows = whole.rows_of_episodes()[out[0]].clone();
            // Rewards equal row indices; one more row, a final state, may follow.
            assert_eq!(
                &held_out.rewards[..rows.len()],
                Vec::from_iter(rows.clone().map(|row| row as f32))
            );
            let again = whole.hold_out(HoldOut::Episodes(&out));
            assert_eq!(
                (again.0.rewards, again.1.rewards),
                (training.rewards.clone(), held_out.rewards.clone())
            );
            let others = (0..7).filter(|row| !rows.contains(row)).map(|row| row as f32);
            assert_eq!(&training.rewards[..7 - rows.len()], Vec::from_iter(others));
            for part in [training, held_out] {
                assert!(
                    part.transitions().all(|row| (row as usize) + 1 < part.rows()),
                    "no next state"
                );
            }
            seen.push(out[0]);
        }
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen, [0, 1, 2, 3], "by the seed");
    }

    #[test]
    fn one_episode_is_left_to_learn_from() {
        let count =
            |fraction, episodes| chosen(HoldOut::Fraction { fraction, seed: 0 }, episodes).len();
        assert_eq!(
            [count(0.0, 10), count(0.1, 10), count(0.01, 10), count(0.9, 2), count(0.5, 1)],
            [0, 1, 1, 1, 0]
        );
    }
}
