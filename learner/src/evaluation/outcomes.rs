//! What the scoreboard is asked, and what it answers.

use std::time::Duration;

use quad_protocol::{EpisodeScore, Hash, Job, Name};

/// Training has come by a step again, and its weights are not those that were scored.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the weights of step {step} are {found}, but {scored} were scored before")]
pub(crate) struct OtherWeights {
    pub step: u64,
    /// Hash of the weights as they are now.
    pub found: Hash,
    /// Hash of those that have scores.
    pub scored: String,
}

/// What a report completed.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Recorded {
    /// Jobs that have no episode left to score: the report's, or another's that came too late.
    pub jobs_completed: usize,
    /// All episodes of its evaluation are scored: their scores, in the order of the evaluation's
    /// seeds.
    pub evaluation_completed: Option<Vec<EpisodeScore>>,
}

/// An evaluator wants a job: the fields of its claim, and how many others may.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Claim<'a> {
    pub evaluator: &'a Name,
    /// Number of the claim; a repeated claim has the number of the first.
    pub attempt: u64,
    /// The environments that it has.
    pub environments: &'a [String],
    /// How many evaluators there are.
    pub present: usize,
}

/// The answer to a claim.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Claimed {
    Job {
        job: Job,
        /// True if the job is handed out once more, because the answer was lost.
        again: bool,
    },
    /// Nothing now; the evaluator is to ask again after this time.
    Wait(Duration),
}

/// A job that its evaluator has handed back.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct HandedBack {
    pub step: u64,
    /// As in [`Lost`].
    pub given_up: Vec<(u64, u64)>,
}

/// Jobs that were taken back.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Lost {
    pub jobs: usize,
    /// Step and seed of the episodes that are not handed out any more, because they were lost too
    /// often.
    pub given_up: Vec<(u64, u64)>,
}
