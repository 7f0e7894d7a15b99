//! What the thread is told.

use std::sync::mpsc::Sender;

use quad_protocol::{Hash, Name};

use super::followed::Follow;
use crate::herald::Herald;
use crate::replies::Question;

/// Messages to the thread.
#[derive(Debug)]
pub enum Event {
    /// A snapshot is ready to be evaluated.
    Evaluate {
        /// After which gradient step.
        step: u64,
        /// Its hash.
        weights: Hash,
    },
    /// All gradient steps are done; no further evaluation will follow.
    TrainingCompleted,
    /// The Zenoh session is open.
    Online {
        /// Who publishes.
        herald: Herald,
        /// Who sees to it that evaluators' tokens are followed.
        follower: Sender<Follow>,
    },
    /// An evaluator asks for a job, or hands one back.
    Job(Question),
    /// An evaluator delivers scores.
    Report(Question),
    /// An evaluator reports a job's progress.
    Progress(Vec<u8>),
    /// An evaluator is there.
    Joined(Name),
    /// An evaluator is gone.
    Left(Name),
    /// The run cannot go on, and why.
    Failed(anyhow::Error),
    /// The scores that the scribe had were written, or why not.
    Written(Result<(), String>),
    /// End, after the messages sent before this one are handled.
    Stop,
}
