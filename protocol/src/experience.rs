//! Experience: an evaluator delivers the rows of online episodes, the learner acknowledges them.
//!
//! An [`Episode`] is one frame, which travels in pieces, because a learner takes small messages
//! only. The hash of the frame names the episode, so pieces of two evaluators that have played the
//! same episode fit together, and bits that differ are noticed.

use bincode::{Decode, Encode};

use crate::codec::{CodecError, LARGE, Message};
use crate::hash::Hash;
use crate::name::Name;
use crate::score::EpisodeScore;

/// An online episode of n steps.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct Episode {
    /// Gradient step of the snapshot that acted.
    pub step: u64,
    /// Hash of the snapshot's file.
    pub weights: Hash,
    /// Arithmetic of the policy, as in a [`ScoreReport`](crate::ScoreReport).
    pub precision: Name,
    /// Seed, length n, return and score.
    pub score: EpisodeScore,
    /// True if the last step terminated the task; else it was truncated, and its next state has a
    /// value.
    pub terminated: bool,
    /// `(n + 1) × o`, from the first observation to the one after the last step, in the
    /// environment's units.
    pub observations: Vec<f32>,
    /// `n × a`, as they were taken.
    pub actions: Vec<f32>,
    /// `n`, as the environment gave them.
    pub rewards: Vec<f32>,
    /// Steps whose action a person took in place of the policy, in ascending order.
    pub interventions: Vec<u32>,
}

impl Episode {
    /// Most steps of an episode.
    pub const LONGEST: usize = 100_000;

    /// The episode of a seed before its first step.
    pub fn new(step: u64, weights: Hash, precision: Name, seed: u64) -> Self {
        Self {
            step,
            weights,
            precision,
            score: EpisodeScore { seed, episode_return: 0.0, length: 0, score: 0.0 },
            terminated: false,
            observations: Vec::new(),
            actions: Vec::new(),
            rewards: Vec::new(),
            interventions: Vec::new(),
        }
    }

    /// Most steps of an episode with these sizes of an observation and an action, so that its frame
    /// is not too long.
    pub fn most_steps((o, a): (usize, usize)) -> usize {
        let row = size_of::<f32>() * (o + a + 2);
        ((Self::LIMIT - (1 << 10)) / row).saturating_sub(1).min(Self::LONGEST)
    }

    /// Sizes of an observation and of an action.
    pub fn dims(&self) -> (usize, usize) {
        let n = self.rewards.len().max(1);
        (self.observations.len() / (n + 1), self.actions.len() / n)
    }
}

impl Message for Episode {
    const KIND: u8 = 7;
    const LIMIT: usize = LARGE;

    fn verify(&self) -> Result<(), CodecError> {
        let Self { score, observations, actions, rewards, interventions, .. } = self;
        let n = rewards.len();
        let malformed = |what: &str| Err(CodecError::Malformed(what.to_owned()));
        if n == 0 || n > Self::LONGEST || n != score.length as usize {
            return malformed("an episode's length is not the number of its rewards");
        }
        if !observations.len().is_multiple_of(n + 1) || !actions.len().is_multiple_of(n) {
            return malformed("an episode's arrays have different lengths");
        }
        let (o, a) = self.dims();
        if o == 0 || a == 0 {
            return malformed("an episode's observations or actions have no numbers");
        }
        let sorted = interventions.is_sorted_by(|a, b| a < b);
        if !sorted || interventions.last().is_some_and(|&last| last as usize >= n) {
            return malformed("an episode's interventions are not among its steps");
        }
        for (array, numbers, width) in
            [("observations", observations, o), ("actions", actions, a), ("rewards", rewards, 1)]
        {
            if let Some(place) = numbers.iter().position(|number| !number.is_finite()) {
                let (row, column, value) = (place / width, place % width, numbers[place]);
                let number = format!("`{array}`, row {row}: number {column} is {value}");
                return malformed(&format!("an episode has a number that is not finite: {number}"));
            }
        }
        Ok(())
    }
}

/// A piece of an episode's frame.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub struct Piece {
    pub evaluator: Name,
    pub run: Name,
    /// The learner's incarnation when it handed the job out.
    pub incarnation: u64,
    /// [`Job::id`](crate::Job::id).
    pub job: u64,
    /// Seed of the episode.
    pub seed: u64,
    /// Hash of the frame.
    pub hash: Hash,
    /// Bytes of the frame.
    pub length: u32,
    /// Bytes of the frame before this piece.
    pub offset: u32,
    pub bytes: Vec<u8>,
}

impl Piece {
    /// Most bytes of the frame in one piece.
    pub const MOST: usize = 28 << 10;
}

impl Message for Piece {
    const KIND: u8 = 8;

    fn verify(&self) -> Result<(), CodecError> {
        let end = self.offset as usize + self.bytes.len();
        let fits = (1..=Self::MOST).contains(&self.bytes.len()) && end <= self.length as usize;
        let problem =
            || CodecError::Malformed("a piece is empty, too large or beyond the end".to_owned());
        fits.then_some(()).ok_or_else(problem)
    }
}

/// The learner's answer to a [`Piece`], with the learner's incarnation.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub enum PieceReply {
    /// The learner has this many bytes of the frame, and waits for the rest.
    Continue { incarnation: u64, offset: u32 },
    /// The episode is on the learner's disk. A duplicate was delivered before and counts once.
    Recorded { incarnation: u64, duplicate: bool },
    /// The episode is permanently refused.
    Refused { incarnation: u64, reason: String },
}

impl PieceReply {
    /// The incarnation of the learner that answers.
    pub fn incarnation(&self) -> u64 {
        match self {
            Self::Continue { incarnation, .. }
            | Self::Recorded { incarnation, .. }
            | Self::Refused { incarnation, .. } => *incarnation,
        }
    }
}

impl Message for PieceReply {
    const KIND: u8 = 9;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::{decode, encode};

    fn episode() -> Episode {
        Episode {
            score: EpisodeScore { seed: 7, episode_return: 3.0, length: 2, score: 3.0 },
            observations: vec![0.0, 0.1, 1.0, 1.1, 2.0, 2.1],
            actions: vec![0.5, -0.5],
            rewards: vec![1.0, 2.0],
            interventions: vec![1],
            ..Episode::new(3, Hash::new(b"weights"), Name::new("f32").unwrap(), 7)
        }
    }

    #[test]
    fn the_longest_episode_fits_into_a_frame() {
        let (o, a) = (5000, 100);
        let n = Episode::most_steps((o, a));
        let longest = Episode {
            observations: vec![0.5; (n + 1) * o],
            actions: vec![0.5; n * a],
            rewards: vec![0.5; n],
            interventions: Vec::from_iter(0..n as u32),
            ..episode()
        };
        assert!(encode(&longest).unwrap().len() > Episode::LIMIT - 64 * (o + a));
        assert_eq!(Episode::most_steps((11, 3)), Episode::LONGEST);
    }

    #[test]
    fn episodes_that_contradict_themselves_or_are_not_finite_are_refused() {
        assert_eq!(decode::<Episode>(&encode(&episode()).unwrap()).unwrap(), episode());
        assert_eq!(episode().dims(), (2, 1));
        type Change = fn(&mut Episode);
        let changes: [(Change, &str); 11] = [
            (|episode| episode.rewards.clear(), "length is not the number of its rewards"),
            (|episode| episode.score.length = 3, "length is not the number of its rewards"),
            (|episode| episode.observations.truncate(5), "arrays have different lengths"),
            (|episode| episode.actions.push(0.0), "arrays have different lengths"),
            (|episode| episode.interventions = vec![2], "interventions are not among its steps"),
            (|episode| episode.interventions = vec![1, 1], "interventions are not among its steps"),
            (|episode| episode.observations.clear(), "have no numbers"),
            (|episode| episode.actions.clear(), "have no numbers"),
            (
                |episode| episode.observations[3] = f32::INFINITY,
                "`observations`, row 1: number 1 is inf",
            ),
            (|episode| episode.actions[1] = f32::NAN, "`actions`, row 1: number 0 is NaN"),
            (|episode| episode.rewards[0] = f32::NAN, "`rewards`, row 0: number 0 is NaN"),
        ];
        for (change, words) in changes {
            let mut episode = episode();
            change(&mut episode);
            let error = decode::<Episode>(&encode(&episode).unwrap()).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }
}
