//! Progress of an evaluator.

use bincode::{Decode, Encode};

use crate::codec::Message;
use crate::job::Job;
use crate::name::Name;

/// How far a job is, and what the evaluator has done so far. Extends the job's lease, if it is
/// further than before.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Progress {
    /// The evaluator.
    pub evaluator: Name,
    /// The run.
    pub run: Name,
    /// The learner's incarnation when it handed the job out.
    pub incarnation: u64,
    /// The job.
    pub job: u64,
    /// Gradient step of its snapshot.
    pub step: u64,
    /// Episodes of the job that have ended.
    pub episodes_done: u32,
    /// Episodes of the job.
    pub episodes_total: u32,
    /// Environment steps of the job. None while its weights are being fetched.
    pub steps_done: u64,
    /// Environment steps of this evaluator since it started, over all of its jobs and runs.
    pub environment_steps: u64,
    /// Episodes of this evaluator since it started, over all of its jobs and runs.
    pub episodes: u64,
}

impl Progress {
    /// Progress of `job` before its first step, by an evaluator that has done nothing yet.
    pub fn of(job: &Job, evaluator: Name) -> Self {
        Self {
            evaluator,
            run: job.run.clone(),
            incarnation: job.incarnation,
            job: job.id,
            step: job.step,
            episodes_done: 0,
            episodes_total: job.seeds.len() as u32,
            steps_done: 0,
            environment_steps: 0,
            episodes: 0,
        }
    }
}

impl Message for Progress {
    const KIND: u8 = 6;
}
