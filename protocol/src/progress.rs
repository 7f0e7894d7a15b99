//! Progress of an evaluator.

use crate::Name;
use crate::codec::{Decode, Encode};

/// How far a job is, and what the evaluator has done so far. Extends the job's lease.
#[derive(Clone, Debug, PartialEq, Eq, Encode, Decode)]
pub struct Progress {
    /// The evaluator.
    pub evaluator: Name,
    /// The run.
    pub run: Name,
    /// The job.
    pub job: u64,
    /// Gradient step of its snapshot.
    pub step: u64,
    /// Episodes of the job that have ended.
    pub episodes_done: u32,
    /// Episodes of the job.
    pub episodes_total: u32,
    /// Environment steps of this evaluator since it started, over all of its jobs and runs.
    pub environment_steps: u64,
    /// Episodes of this evaluator since it started, over all of its jobs and runs.
    pub episodes: u64,
}
