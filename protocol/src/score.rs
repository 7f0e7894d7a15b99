//! Scores: an evaluator delivers them, the learner acknowledges them and publishes what it has recorded.

use crate::codec::{Decode, Encode};
use crate::{Hash, Name};

/// The result of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub struct EpisodeScore {
    /// Seed of the episode.
    pub seed: u64,
    /// Sum of its rewards.
    pub episode_return: f64,
    /// Its environment steps.
    pub length: u32,
    /// D4RL's normalised score: 100 · (return − random) / (expert − random).
    pub score: f64,
}

/// An evaluator delivers the episodes of a job.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct ScoreReport {
    /// Who delivers.
    pub evaluator: Name,
    /// The run.
    pub run: Name,
    /// The learner's incarnation when it handed the job out.
    pub incarnation: u64,
    /// The job.
    pub job: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Hash of the snapshot's tensors.
    pub weights: Hash,
    /// The arithmetic that the policy was computed in, e.g. `f32` or `bf16`.
    pub precision: Name,
    /// The episodes.
    pub episodes: Vec<EpisodeScore>,
    /// Why there are none: the policy cannot act, because something on the way to an action is not a number. No other
    /// evaluator would fare better.
    pub cannot_act: Option<String>,
}

/// The learner's answer to a [`ScoreReport`].
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub enum ScoreReply {
    /// They are on the learner's disk.
    Recorded {
        /// Episodes that were not known before.
        new: u32,
        /// Episodes that were delivered before; they count once.
        duplicates: u32,
    },
    /// They were not accepted and never will be; do not send them again.
    Refused {
        /// Why, for people.
        reason: String,
    },
}

/// Scores that the learner has recorded, published for observers.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub struct RecordedScores {
    /// The run.
    pub run: Name,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Hash of the snapshot's tensors.
    pub weights: Hash,
    /// Who measured.
    pub evaluator: Name,
    /// The episodes.
    pub episodes: Vec<EpisodeScore>,
}
