//! Messages from the learner's threads to its main loop, which shows them and decides when the run is over.

use quad_protocol::{EpisodeScore, Name};

use crate::trouble::Saved;

/// Something that happened.
#[derive(Debug)]
pub enum Notice {
    /// A snapshot is ready to be evaluated.
    Published {
        /// After which gradient step.
        step: u64,
    },
    /// An evaluator connected.
    EvaluatorJoined(Name),
    /// An evaluator left; this many jobs that it had not finished were taken back.
    EvaluatorLeft(Name, usize),
    /// So many others connected and left, in some seconds.
    EvaluatorsChanged {
        /// How many connected.
        joined: usize,
        /// How many left.
        left: usize,
    },
    /// An evaluator could not do a job; told once for each step.
    JobFailed {
        /// Gradient step of its snapshot.
        step: u64,
        /// Who.
        evaluator: Name,
        /// Why, in its words.
        reason: String,
    },
    /// Episodes, by step and seed, that are not handed out any more: too many evaluators were lost with them or could not do
    /// them.
    GivenUp(Vec<(u64, u64)>),
    /// This many jobs were taken back because their leases ran out.
    JobsExpired(usize),
    /// All episodes of an evaluation are scored.
    Evaluated {
        /// Gradient step of its snapshot.
        step: u64,
        /// The scores, in the order of the evaluation's seeds.
        scores: Vec<EpisodeScore>,
    },
    /// All gradient steps are done, and every snapshot was handed to evaluation.
    Trained {
        /// Episodes that have no score yet.
        pending: usize,
    },
    /// All gradient steps are done, and no score is outstanding that may still come.
    Settled,
    /// All is settled, but so many episodes were to be scored a second time and were not.
    Unchecked(u64),
    /// These two evaluators have different scores of the same episode.
    ScoresDiffer([Name; 2]),
    /// The disk does not take that; what it says.
    DiskTrouble(Saved, String),
    /// The disk takes it again.
    DiskWell(Saved),
    /// The run cannot go on.
    Failed(anyhow::Error),
}
