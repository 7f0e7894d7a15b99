//! Scores: an evaluator delivers them, the learner acknowledges them.

use bincode::{Decode, Encode};
use serde::Serialize;

use crate::codec::Message;
use crate::hash::Hash;
use crate::job::Job;
use crate::name::Name;

/// The result of one episode.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode, Serialize)]
pub struct EpisodeScore {
    /// Seed of the episode.
    pub seed: u64,
    /// Sum of its rewards.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Its environment steps.
    pub length: u32,
    /// Its score: D4RL's normalized one, 100 · (return − random) / (expert − random), where the
    /// environment has such references; else what the evaluator's user counts, by default the
    /// return.
    pub score: f64,
}

impl EpisodeScore {
    /// Largest return or score that counts, whichever its sign. It is far above any use; statistics
    /// of larger ones would not be finite.
    pub const LARGEST: f64 = 1e12;

    /// Whether a return or a score is finite and no larger than [`LARGEST`](Self::LARGEST).
    pub fn counts(value: f64) -> bool {
        value.abs() <= Self::LARGEST
    }
}

/// An evaluator delivers the episodes of a job. The learner records them even if the job has gone
/// to another evaluator, or an earlier incarnation of the learner handed it out: what counts is
/// that run, step, weights and seeds are those of an evaluation.
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
    /// Hash of the snapshot's file.
    pub weights: Hash,
    /// The arithmetic that the policy's actions were computed in, e.g. `f32-avx2` or `bf16-amx`:
    /// the same name gives the same bits.
    pub precision: Name,
    /// The episodes.
    pub episodes: Vec<EpisodeScore>,
}

impl ScoreReport {
    /// What `evaluator` has measured in `job`.
    pub fn of(job: &Job, evaluator: Name, precision: Name, episodes: Vec<EpisodeScore>) -> Self {
        let Job { run, incarnation, id, step, weights, .. } = job.clone();
        Self { evaluator, run, incarnation, job: id, step, weights, precision, episodes }
    }
}

/// The learner's answer to a [`ScoreReport`].
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub enum ScoreReply {
    /// They are on the learner's disk.
    Recorded {
        /// The learner's incarnation.
        incarnation: u64,
        /// Episodes that were not known before.
        new: u32,
        /// Episodes that were delivered before; they count once.
        duplicates: u32,
    },
    /// They were not accepted and never will be; do not send them again.
    Refused {
        /// The learner's incarnation.
        incarnation: u64,
        /// Why, for people.
        reason: String,
    },
}

impl ScoreReply {
    /// The incarnation of the learner that answers.
    pub fn incarnation(&self) -> u64 {
        match self {
            Self::Recorded { incarnation, .. } | Self::Refused { incarnation, .. } => *incarnation,
        }
    }
}

impl Message for ScoreReport {
    const KIND: u8 = 4;
}

impl Message for ScoreReply {
    const KIND: u8 = 5;
}
