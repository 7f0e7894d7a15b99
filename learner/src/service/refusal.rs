//! Reasons not to accept a message about a job or its scores.

#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("it is for another run")]
    Run,
    #[error("it is for another incarnation of the learner")]
    Incarnation,
    #[error("the evaluator has no such job")]
    Job,
    #[error("the job is not further than before")]
    NotAdvanced,
    #[error("the run has no evaluation of that step")]
    Step,
    /// The only one that is not final.
    #[error("training has not come to that step since the learner's start")]
    NotYet,
    #[error("the evaluation of that step is about other weights")]
    Weights,
    #[error("seed {0} is not in the evaluation, or twice in the report")]
    Seed(u64),
    #[error("the episode with seed {0} has an impossible length, return or score")]
    Episode(u64),
    #[error("the run has no online episode with seed {0}")]
    Online(u64),
    #[error(
        "the episode with seed {0} has observations or actions of another size, or is too long"
    )]
    Rows(u64),
    #[error("there are too many evaluators")]
    Crowd,
}

impl Refusal {
    /// The reason as a metric's label.
    pub fn label(self) -> &'static str {
        match self {
            Self::Run => "unknown_run",
            Self::Incarnation => "unknown_incarnation",
            Self::Job => "unknown_job",
            Self::NotAdvanced => "not_advanced",
            Self::Step => "unknown_step",
            Self::NotYet => "not_open_yet",
            Self::Weights => "unknown_weights",
            Self::Seed(_) => "unknown_seed",
            Self::Episode(_) => "impossible_episode",
            Self::Online(_) => "unknown_online",
            Self::Rows(_) => "impossible_rows",
            Self::Crowd => "too_many_evaluators",
        }
    }
}

/// `refusal`, unless `holds`.
pub(super) fn require(holds: bool, refusal: Refusal) -> Result<(), Refusal> {
    if holds { Ok(()) } else { Err(refusal) }
}
