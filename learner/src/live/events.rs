//! What the other threads report to the main loop.

use quad_protocol::{EpisodeScore, Name};
use tokio::sync::mpsc::UnboundedSender;

use crate::train::Outcome;

/// The sender of events. Events that the network can cause are sent once for each step, name or
/// period, so the queue stays short.
pub(crate) type Events = UnboundedSender<Event>;

/// A report to the main loop.
#[derive(Debug)]
pub(crate) enum Event {
    /// A snapshot of this step is ready to be evaluated.
    Published { step: u64 },
    /// An evaluator could not run a job; its error message. Sent once for each step.
    JobFailed { step: u64, evaluator: Name, reason: String },
    /// Episodes, by step and seed, that the learner has given up: too many evaluators were lost
    /// with them or could not run them.
    GivenUp(Vec<(u64, u64)>),
    /// Two evaluators have this name: one works on a job, the other one has asked for one
    /// meanwhile. Sent once for each name.
    SameName(Name),
    /// All episodes of an evaluation are scored; the scores are in the order of the evaluation's
    /// seeds.
    Evaluated { step: u64, scores: Vec<EpisodeScore> },
    /// No gradient step will follow, and all output of training is on the disk.
    TrainingEnded(Outcome),
    /// The disk refuses this output; its error message.
    DiskTrouble(Saved, String),
    /// The disk accepts this output again.
    DiskWell(Saved),
    /// The run cannot continue.
    Failed(anyhow::Error),
}

/// Output of a thread on the disk.
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

    /// The name in messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Run => "the run",
            Self::Scores => "scores",
        }
    }

    /// The name of the thread that writes this output.
    pub fn thread(self) -> &'static str {
        match self {
            Self::Run => "snapshots",
            Self::Scores => "scores",
        }
    }
}
