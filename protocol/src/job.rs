//! Jobs: an evaluator claims one, tells its progress, or hands it back.

use std::time::Duration;

use bincode::{Decode, Encode};

use crate::codec::{CodecError, Message};
use crate::hash::Hash;
use crate::name::Name;

/// An evaluator's request about jobs.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[allow(missing_docs)] // Names of evaluator and job.
pub enum JobRequest {
    /// Asks for a job.
    Claim {
        evaluator: Name,
        /// A random number. A claim that is repeated because no answer came has the same number and
        /// gets the same job.
        attempt: u64,
        /// Environments that the evaluator can simulate.
        environments: Vec<String>,
    },
    /// Gives up a job.
    HandBack {
        evaluator: Name,
        /// [`Job::id`].
        job: u64,
        /// Error message; none if the evaluator only leaves.
        failed: Option<String>,
    },
}

/// The learner's answer to a [`JobRequest`], with the learner's incarnation.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub enum JobReply {
    Job(Job),
    /// There is no job now; ask again after this time.
    Wait {
        incarnation: u64,
        milliseconds: u64,
    },
    /// The answer to [`JobRequest::HandBack`].
    HandedBack {
        incarnation: u64,
        /// True if the evaluator still had the job.
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

/// Actions in online episodes.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub enum Exploration {
    /// Uniform in [-1, 1] in each dimension.
    Uniform,
    /// The policy's, drawn from its distribution where it has one, plus normal noise with this
    /// standard deviation, clipped to [-1, 1].
    Policy {
        /// Standard deviation of the noise, from 0 to 1.
        noise: f32,
    },
}

/// Episodes to run with one snapshot.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub struct Job {
    /// Number within the learner's incarnation.
    pub id: u64,
    pub run: Name,
    /// The learner's incarnation.
    pub incarnation: u64,
    /// Gradient step of the snapshot.
    pub step: u64,
    /// Hash of the snapshot's file.
    pub weights: Hash,
    pub environment: String,
    /// Seed of what an environment draws once for all episodes (AntMaze-v0: its goal); the same for
    /// a whole run.
    pub environment_seed: u64,
    /// A seed per episode.
    pub seeds: Vec<u64>,
    /// Exploration of online episodes, whose rows are delivered as
    /// [`Episode`](crate::Episode)s; `None` for evaluation episodes, of which scores are.
    pub exploration: Option<Exploration>,
    /// Interval of progress messages; after three intervals without progress, the job may go to
    /// another evaluator.
    pub progress_milliseconds: u64,
}

impl Job {
    /// Longest time for a job, whatever its progress.
    pub const LONGEST: Duration = Duration::from_secs(24 * 3600);
}

/// Progress of a job, and totals of the evaluator since it started. Extends the job's lease if it
/// shows more progress than the message before.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
#[allow(missing_docs)] // The names say it.
pub struct Progress {
    pub evaluator: Name,
    pub run: Name,
    /// The learner's incarnation when it handed the job out.
    pub incarnation: u64,
    /// [`Job::id`].
    pub job: u64,
    /// Episodes of the job that have ended.
    pub episodes_done: u32,
    /// Environment steps of the job; 0 while its weights are fetched.
    pub steps_done: u64,
    /// Environment steps of all of the evaluator's jobs.
    pub environment_steps: u64,
    /// Episodes of all of the evaluator's jobs.
    pub episodes: u64,
}

impl Progress {
    /// Progress of `job` before its first step, by an evaluator without earlier jobs.
    pub fn new(job: &Job, evaluator: Name) -> Self {
        Self {
            evaluator,
            run: job.run.clone(),
            incarnation: job.incarnation,
            job: job.id,
            episodes_done: 0,
            steps_done: 0,
            environment_steps: 0,
            episodes: 0,
        }
    }
}

impl Message for JobRequest {
    const KIND: u8 = 2;
}

impl Message for JobReply {
    const KIND: u8 = 3;

    fn verify(&self) -> Result<(), CodecError> {
        match self {
            Self::Job(Job { exploration: Some(Exploration::Policy { noise }), .. })
                if !(0.0..=1.0).contains(noise) =>
            {
                Err(CodecError::Malformed(format!("a job's noise is {noise}, not from 0 to 1")))
            }
            _ => Ok(()),
        }
    }
}

impl Message for Progress {
    const KIND: u8 = 6;
}
