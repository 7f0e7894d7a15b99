//! Progress of an evaluator.

use bincode::{Decode, Encode};

use crate::codec::Message;
use crate::job::Job;
use crate::name::Name;

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

impl Message for Progress {
    const KIND: u8 = 6;
}
