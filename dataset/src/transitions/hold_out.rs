//! Validation episodes.

use std::ops::Range;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use crate::recording::{Recording, RowKind};

/// Seed of the choice. All runs on the same data hold out the same episodes, so that judging
/// compares them; a larger fraction adds to those of a smaller one.
const SEED: u64 = u64::from_be_bytes(*b"hold out");

/// Episodes that are kept out of training.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum HoldOut<'a> {
    /// Fraction of the episodes between 0 (none) and 1, by their number alone.
    Fraction(f64),
    /// Indices of episodes in ascending order, from 0 in file order.
    Episodes(&'a [usize]),
}

impl HoldOut<'_> {
    pub(crate) const NONE: Self = Self::Episodes(&[]);
}

/// Indices in ascending order. A fraction above 0 leaves at least one episode on each side.
pub(crate) fn chosen(hold_out: HoldOut<'_>, episodes: usize) -> Vec<usize> {
    let fraction = match hold_out {
        HoldOut::Fraction(fraction) => fraction,
        HoldOut::Episodes(numbers) => return numbers.to_vec(),
    };
    let mut numbers = Vec::from_iter(0..episodes);
    numbers.shuffle(&mut ChaCha8Rng::seed_from_u64(SEED));
    let count = (fraction * episodes as f64).round() as usize;
    let count = count.max(usize::from(fraction > 0.0));
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

    /// Training episodes, held-out episodes if there are any, and the indices of the latter.
    pub(crate) fn hold_out(mut self, hold_out: HoldOut<'_>) -> (Self, Option<Self>, Vec<usize>) {
        let episodes = self.rows_of_episodes();
        let out = chosen(hold_out, episodes.len());
        if out.is_empty() {
            return (self, None, out);
        }
        let (mut held_out, mut kept) = (self.like(), Vec::new());
        for (number, rows) in episodes.into_iter().enumerate() {
            match out.binary_search(&number) {
                Ok(_) => held_out.extend(&self, rows),
                Err(_) => kept.push(rows),
            }
        }
        self.keep(&kept);
        self.close();
        held_out.close();
        (self, Some(held_out), out)
    }

    /// Drops all other rows in place: there may be no memory for a second dataset.
    fn keep(&mut self, kept: &[Range<usize>]) {
        let (states, actions) = (self.observation_dim, self.action_dim);
        if let Some(next) = &mut self.next_observations {
            keep(next, states, kept);
            keep(&mut self.jumps, 1, kept);
        }
        keep(&mut self.observations, states, kept);
        keep(&mut self.actions, actions, kept);
        keep(&mut self.rewards, 1, kept);
        keep(&mut self.kinds, 1, kept);
        for flags in [&mut self.terminals, &mut self.timeouts, &mut self.ends] {
            keep(flags, 1, kept);
        }
    }

    fn like(&self) -> Recording {
        Recording {
            observation_dim: self.observation_dim,
            action_dim: self.action_dim,
            next_observations: self.next_observations.as_ref().map(|_| Vec::new()),
            goal: self.goal,
            names: self.names.clone(),
            ..Recording::default()
        }
    }

    pub(crate) fn extend(&mut self, from: &Recording, rows: Range<usize>) {
        let columns = |width: usize| rows.start * width..rows.end * width;
        let (states, actions) = (columns(from.observation_dim), columns(from.action_dim));
        if let (Some(next), Some(stored)) = (&mut self.next_observations, &from.next_observations) {
            next.extend_from_slice(&stored[states.clone()]);
            self.jumps.extend_from_slice(&from.jumps[rows.clone()]);
        }
        self.observations.extend_from_slice(&from.observations[states]);
        self.actions.extend_from_slice(&from.actions[actions]);
        self.rewards.extend_from_slice(&from.rewards[rows.clone()]);
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
        let last = (self.rows() - 1) * self.observation_dim;
        self.observations.extend_from_within(last..);
        self.push_last_state();
    }
}

/// Moves the rows that stay, in ascending order, to the front of a column.
fn keep<T: Copy>(column: &mut Vec<T>, width: usize, kept: &[Range<usize>]) {
    let mut end = 0;
    for rows in kept {
        column.copy_within(rows.start * width..rows.end * width, end);
        end += rows.len() * width;
    }
    column.truncate(end);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::tests::recording;

    fn whole() -> Recording {
        use RowKind::{Dropped, LastState, Transition};
        let mut whole = recording(&[
            Transition, Transition, Transition, Dropped, Transition, LastState, Transition,
        ]);
        (whole.ends[1], whole.terminals[1], whole.ends[3]) = (true, true, true);
        whole
    }

    #[test]
    fn episodes_are_kept_out_whole() {
        let episodes = [0..2, 2..4, 4..6, 6..7];
        assert_eq!(whole().rows_of_episodes(), episodes);
        for (number, rows) in episodes.iter().enumerate() {
            let all = whole();
            let place = all.observations.as_ptr();
            let (training, held_out, out) = all.hold_out(HoldOut::Episodes(&[number]));
            let held_out = held_out.unwrap();
            assert_eq!(out, [number]);
            assert_eq!(training.observations.as_ptr(), place, "a copy takes as much memory again");
            let (own, others): (Vec<usize>, _) = (0..7).partition(|row| rows.contains(row));
            // Rewards and observations equal row indices; one more row, a final state, may follow.
            for (part, rows) in [(&held_out, own), (&training, others)] {
                let rewards = Vec::from_iter(rows.into_iter().map(|row| row as f32));
                assert_eq!(part.rewards[..rewards.len()], rewards);
                assert_eq!(part.observations[..rewards.len()], rewards);
                let is_last = |row: usize| row + 1 == part.rows();
                assert!(!part.transitions().any(is_last), "no next state");
            }
        }
    }

    #[test]
    fn the_nearest_number_is_held_out_and_one_episode_left_to_learn_from() {
        let count = |(fraction, episodes)| chosen(HoldOut::Fraction(fraction), episodes).len();
        let counts =
            [(0.0, 10), (0.1, 10), (0.1, 16), (0.29, 9), (0.01, 10), (0.9, 2), (0.5, 1)].map(count);
        assert_eq!(counts, [0, 1, 2, 3, 1, 1, 0]);
    }

    #[test]
    fn a_larger_fraction_holds_out_those_of_a_smaller_one_too() {
        let [few, many] = [0.1, 0.3].map(|fraction| chosen(HoldOut::Fraction(fraction), 100));
        assert!(few.iter().all(|episode| many.contains(episode)), "{few:?} are not of {many:?}");
        assert_ne!(few, Vec::from_iter(0..10), "not the first of the file");
    }
}
