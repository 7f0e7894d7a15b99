//! An evaluator asks for work and gets some.

use crate::codec::{Decode, Encode};
use crate::{Hash, Name};

/// An evaluator claims a job.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct JobRequest {
    /// Who asks.
    pub evaluator: Name,
    /// The environments it has.
    pub environments: Vec<String>,
}

/// The learner's answer to a [`JobRequest`].
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub enum JobReply {
    /// Work.
    Job(Job),
    /// None now; ask again after so many milliseconds.
    Wait {
        /// How long to wait.
        milliseconds: u64,
    },
}

/// Episodes to run with one snapshot, all of them with the same weights.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Job {
    /// Number of the job, counted within the learner's incarnation.
    pub id: u64,
    /// The run.
    pub run: Name,
    /// The learner's incarnation when it handed the job out.
    pub incarnation: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Hash of the snapshot's tensors.
    pub weights: Hash,
    /// Environment to act in.
    pub environment: String,
    /// Seed of what an environment draws once and keeps over all episodes (AntMaze-v0: its goal); the same for a whole run.
    pub instance: u64,
    /// One episode for each seed.
    pub seeds: Vec<u64>,
    /// Actions that the policy draws in each state before it takes the best (the paper's N_a).
    pub candidates: u32,
    /// After so many milliseconds without a progress message the job goes to another evaluator.
    pub lease_milliseconds: u64,
}
