//! Arguments and results of the scoreboard.

use std::time::Duration;

use quad_protocol::{EpisodeScore, Exploration, Hash, Job, Name};

/// Retrained weights differ from the scored ones.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the weights of step {step} are {found}, but {scored} were scored before")]
pub struct OtherWeights {
    pub step: u64,
    /// Hash of the retrained weights.
    pub found: Hash,
    /// Hash of the weights that have scores.
    pub scored: String,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Recorded {
    /// Jobs that have no episode left to score: the report's, or another's that came too late.
    pub jobs_completed: usize,
    /// All scores of the report's evaluation, in the order of its seeds, if this completed it.
    pub evaluation_completed: Option<Vec<EpisodeScore>>,
}

/// An online episode that evaluators may play.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Opening {
    /// Number of the episode, from 0: experience enters the buffer in this order.
    pub episode: u64,
    /// Gradient step of the snapshot that acts.
    pub step: u64,
    pub seed: u64,
    pub exploration: Exploration,
}

/// An online episode as the learner knows it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum OnlineEpisodeState {
    /// It is waited for.
    Open { episode: u64 },
    /// It was recorded, with a frame of this hash.
    Recorded(Hash),
    /// It may be one of an earlier incarnation, which training opens again when it comes there.
    NotYet,
}

/// A request for a job.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Claim<'a> {
    pub evaluator: &'a Name,
    /// Number of the claim; a repeated claim has the number of the first.
    pub attempt: u64,
    /// True if the evaluator has the run's environment.
    pub fits: bool,
    /// Number of connected evaluators.
    pub present: usize,
}

#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Claimed {
    Job {
        job: Job,
        /// True if the job is handed out once more, because the answer was lost.
        again: bool,
    },
    /// There is no job now; the evaluator is to ask again after this time.
    Wait(Duration),
}

/// Jobs that were taken back.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Lost {
    pub jobs: usize,
    /// Step and seed of the episodes that are given up.
    pub given_up: Vec<(u64, u64)>,
}
