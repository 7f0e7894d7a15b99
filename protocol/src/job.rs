//! An evaluator asks for work and gets some, or gives it back.

use std::time::Duration;

use bincode::{Decode, Encode};

use crate::codec::Message;
use crate::hash::Hash;
use crate::name::Name;

/// What an evaluator asks a learner about jobs.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub enum JobRequest {
    /// It wants one.
    Claim {
        /// Who asks.
        evaluator: Name,
        /// A random number, the same when the claim is sent again because no answer came: it is
        /// answered with the same job again.
        attempt: u64,
        /// The environments it has.
        environments: Vec<String>,
    },
    /// It will not do the one that it has.
    HandBack {
        /// Who hands it back.
        evaluator: Name,
        /// [`Job::id`].
        job: u64,
        /// Why it could not do it, for people; nothing if it only leaves.
        failed: Option<String>,
    },
}

/// The learner's answer to a [`JobRequest`].
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub enum JobReply {
    /// Work.
    Job(Job),
    /// None now; ask again after so many milliseconds.
    Wait {
        /// The learner's incarnation.
        incarnation: u64,
        /// How long to wait.
        milliseconds: u64,
    },
    /// The answer to [`JobRequest::HandBack`].
    HandedBack {
        /// The learner's incarnation.
        incarnation: u64,
        /// Whether the evaluator still had the job; if not, there was nothing to hand back.
        accepted: bool,
    },
}

impl JobReply {
    /// The incarnation of the learner that answers.
    pub fn incarnation(&self) -> u64 {
        match self {
            Self::Job(job) => job.incarnation,
            Self::Wait { incarnation, .. } | Self::HandedBack { incarnation, .. } => *incarnation,
        }
    }
}

/// Episodes to run with one snapshot, all of them with the same weights.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Job {
    /// Number of the job, counted within the learner's incarnation.
    pub id: u64,
    /// The run.
    pub run: Name,
    /// The learner's incarnation.
    pub incarnation: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Hash of the snapshot's file.
    pub weights: Hash,
    /// Environment to act in.
    pub environment: String,
    /// Seed of what an environment draws once and keeps over all episodes (AntMaze-v0: its goal);
    /// the same for a whole run.
    pub environment_seed: u64,
    /// One episode for each seed.
    pub seeds: Vec<u64>,
    /// Progress is to be told this often; after three times as long without any, the job may go to
    /// another evaluator.
    pub progress_milliseconds: u64,
}

impl Job {
    /// Longest time that an evaluator may have a job, whatever its progress.
    pub const LONGEST: Duration = Duration::from_secs(24 * 3600);
}

impl Message for JobRequest {
    const KIND: u8 = 2;
}

impl Message for JobReply {
    const KIND: u8 = 3;
}
