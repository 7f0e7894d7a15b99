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
    /// Sum of rewards.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Environment steps.
    pub length: u32,
    /// D4RL's normalized score, 100 · (return − random) / (expert − random), where the environment
    /// has reference returns; else the evaluator's own measure, by default the return.
    pub score: f64,
}

impl EpisodeScore {
    /// Largest absolute return or score that counts: far above any use, and small enough for finite
    /// statistics.
    pub const LARGEST: f64 = 1e12;

    /// True if a return or a score is finite and no larger than [`LARGEST`](Self::LARGEST).
    pub fn is_in_range(value: f64) -> bool {
        value.abs() <= Self::LARGEST
    }
}

/// The episodes of a job. The learner also records them if the job has gone to another evaluator or
/// is of an earlier incarnation, as long as run, step, weights and seeds are those of an evaluation.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub struct ScoreReport {
    pub evaluator: Name,
    pub run: Name,
    /// The learner's incarnation when it handed the job out.
    pub incarnation: u64,
    /// [`Job::id`].
    pub job: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Hash of the snapshot's file.
    pub weights: Hash,
    /// Arithmetic of the policy, e.g. `f32-avx2` or `bf16-amx`: the same name gives the same bits.
    pub precision: Name,
    pub episodes: Vec<EpisodeScore>,
}

impl ScoreReport {
    /// The report of a job.
    pub fn new(job: &Job, evaluator: Name, precision: Name, episodes: Vec<EpisodeScore>) -> Self {
        let Job { run, incarnation, id: job, step, weights, .. } = job.clone();
        Self { evaluator, run, incarnation, job, step, weights, precision, episodes }
    }
}

/// The learner's answer to a [`ScoreReport`], with the learner's incarnation.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub enum ScoreReply {
    /// The scores are on the learner's disk. Duplicates were delivered before and count once.
    Recorded { incarnation: u64, new: u32, duplicates: u32 },
    /// Training has not come to the step since the learner's start: deliver the scores again later.
    NotYet { incarnation: u64 },
    /// The scores are permanently refused.
    Refused { incarnation: u64, reason: String },
}

impl ScoreReply {
    /// The incarnation of the learner that answers.
    pub fn incarnation(&self) -> u64 {
        match self {
            Self::Recorded { incarnation, .. }
            | Self::NotYet { incarnation }
            | Self::Refused { incarnation, .. } => *incarnation,
        }
    }
}

impl Message for ScoreReport {
    const KIND: u8 = 4;
}

impl Message for ScoreReply {
    const KIND: u8 = 5;
}
