//! What the threads tell the main loop.

use quad_protocol::{EpisodeScore, Name};
use tokio::sync::mpsc::UnboundedSender;

use crate::train::Outcome;

/// Where events go. What the network can cause is told once for each step, name or period, so the queue stays short.
pub(crate) type Events = UnboundedSender<Event>;

/// Something that happened.
#[derive(Debug)]
pub(crate) enum Event {
    /// A snapshot of this step is ready to be evaluated.
    Published { step: u64 },
    /// An evaluator could not do a job, and why, in its words; told once for each step.
    JobFailed { step: u64, evaluator: Name, reason: String },
    /// Episodes, by step and seed, that are not handed out any more: too many evaluators were lost with them or could not do
    /// them.
    GivenUp(Vec<(u64, u64)>),
    /// An evaluator that has a job has asked for another one; told once for each name.
    SameName(Name),
    /// All episodes of an evaluation are scored; the scores are in the order of the evaluation's seeds.
    Evaluated { step: u64, scores: Vec<EpisodeScore> },
    /// No gradient step will follow, and everything that training made is on the disk.
    TrainingEnded(Outcome),
    /// The disk does not take that; what it says.
    DiskTrouble(Saved, String),
    /// The disk takes it again.
    DiskWell(Saved),
    /// The run cannot go on.
    Failed(anyhow::Error),
}

/// What a thread writes to the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Saved {
    /// Snapshots, checkpoints and metrics.
    Run,
    /// Scores.
    Scores,
}

impl Saved {
    pub const ALL: [Self; 2] = [Self::Run, Self::Scores];

    /// The metric's label.
    pub fn label(self) -> &'static str {
        match self {
            Self::Run => "run",
            Self::Scores => "scores",
        }
    }

    /// For people.
    pub fn name(self) -> &'static str {
        match self {
            Self::Run => "the run",
            Self::Scores => "scores",
        }
    }

    /// The thread that writes it.
    pub fn thread(self) -> &'static str {
        match self {
            Self::Run => "snapshots",
            Self::Scores => "scores",
        }
    }
}
