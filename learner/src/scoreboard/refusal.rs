//! Why a message about a job is not accepted.

/// Why a message about a job is not accepted.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum Refusal {
    /// For another run.
    #[error("it is for another run")]
    Run,
    /// For a job of another life of the learner.
    #[error("it is for another incarnation of the learner")]
    Incarnation,
    /// No such job is open.
    #[error("no such job is open")]
    Job,
    /// The job was handed out to somebody else.
    #[error("the job was handed out to another evaluator")]
    Evaluator,
    /// Not from whoever got the job.
    #[error("it does not prove that its sender has the job's lease")]
    Proof,
    /// Not further than the last one.
    #[error("the job is not further than before")]
    NotAdvanced,
    /// No evaluation of that step.
    #[error("there is no evaluation of that step")]
    Step,
    /// Not the weights of the evaluation.
    #[error("the evaluation of that step is about other weights")]
    Weights,
    /// An episode that the evaluation does not have, or the same one twice.
    #[error("seed {0} is not in the evaluation, or twice in the report")]
    Seed(u64),
    /// An episode with values that no episode of the environment can have.
    #[error("the episode with seed {0} has an impossible length, return or score")]
    Episode(u64),
}

impl Refusal {
    /// The reason as a metric's label.
    pub fn label(&self) -> &'static str {
        match self {
            Self::Run => "unknown_run",
            Self::Incarnation => "unknown_incarnation",
            Self::Job => "unknown_job",
            Self::Evaluator => "wrong_evaluator",
            Self::Proof => "wrong_proof",
            Self::NotAdvanced => "not_advanced",
            Self::Step => "unknown_step",
            Self::Weights => "unknown_weights",
            Self::Seed(_) => "unknown_seed",
            Self::Episode(_) => "impossible_episode",
        }
    }
}

/// `refusal`, unless `holds`.
pub(super) fn require(holds: bool, refusal: Refusal) -> Result<(), Refusal> {
    if holds { Ok(()) } else { Err(refusal) }
}
