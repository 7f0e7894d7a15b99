//! What the learner's threads tell its main loop, for the display and for the decision when to end.

use quad_protocol::{EpisodeScore, Name};

/// Something that happened.
#[derive(Debug)]
pub enum Notice {
    /// A snapshot is ready to be evaluated.
    Published {
        /// After which gradient step.
        step: u64,
    },
    /// An evaluator came.
    EvaluatorJoined(Name),
    /// An evaluator went, and with it so many unfinished jobs.
    EvaluatorLeft(Name, usize),
    /// So many jobs went without progress for too long and were taken back.
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
    /// All gradient steps are done, and no score is outstanding.
    Settled,
    /// The run cannot go on.
    Failed(anyhow::Error),
}
