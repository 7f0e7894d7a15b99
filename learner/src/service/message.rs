//! Messages and events that the service takes, and what it orders.

use std::sync::Arc;

use quad_protocol::{
    CodecError, Episode, EpisodeScore, Hash, JobReply, JobRequest, Name, Piece, PieceReply,
    Progress, ScoreReply, ScoreReport, decode,
};
use quad_run::folder::ScoreLine;

use super::Opening;

/// A message or an event. `Q` is a query, by which its answer finds the way back.
#[derive(Debug)]
pub enum Input<Q> {
    Job(Q, JobRequest),
    /// Queued until [`Input::Flush`].
    Scores(Q, ScoreReport),
    /// Queued until [`Input::Flush`].
    Piece(Q, Piece),
    Progress(Progress),
    Joined(Name),
    Left(Name),
    /// A message of another version of the protocol.
    OtherVersion(CodecError),
    /// A snapshot to evaluate is on the disk.
    Snapshot {
        step: u64,
        weights: Hash,
    },
    /// An online episode may be played, with a snapshot that is on the disk.
    Opened(Opening, Hash),
    /// Training waits for the online episode with this number from now on.
    Waits(u64),
    /// All gradient steps are made, and their output is on the disk.
    Trained,
    /// The disk is free for what is queued.
    Flush,
    /// A frame that [`Order::Decode`] gave out, and its episode.
    Decoded(Frame<Q>, Result<Box<Episode>, CodecError>),
    /// Results of the last [`Order::Append`]: of scores and of experience.
    Appended([Result<(), String>; 2]),
    /// Some time has passed, in which training may have waited for an online episode.
    Tick {
        training_waits: bool,
    },
}

/// Work for the caller, to be done in this order.
#[derive(Debug)]
pub enum Order<Q> {
    Reply(Q, Answer),
    /// Verify and decode a frame, which takes long, and return it as [`Input::Decoded`].
    Decode(Frame<Q>),
    /// Append to `scores.jsonl` and `experience.log`, durably, and report as [`Input::Appended`].
    Append {
        scores: Vec<ScoreLine>,
        frames: Vec<Arc<Vec<u8>>>,
    },
    /// An episode with this number is on the disk; training takes it in the order of numbers.
    Learn {
        number: u64,
        episode: Box<Episode>,
    },
    /// An evaluation is complete; if `earlier`, an earlier incarnation has completed it.
    Evaluated {
        step: u64,
        scores: Vec<EpisodeScore>,
        earlier: bool,
    },
    /// A line for the user.
    Tell(String),
    /// Advise the user to start an evaluator.
    Advise,
    /// Show an evaluator's totals.
    Show(Progress),
    /// Show an evaluator's totals no longer.
    Forget(Name),
    Count(Count),
    End(End),
}

/// An event that is counted.
#[derive(Debug, PartialEq)]
pub enum Count {
    /// Jobs by outcome.
    Jobs(&'static str, usize),
    /// A message that was not accepted, by reason.
    Rejected(&'static str),
    Scores {
        new: u32,
        duplicates: u32,
    },
    /// An online episode came again with other bits.
    Difference,
}

/// An end of the run.
#[derive(Debug, PartialEq)]
pub enum End {
    /// Training is complete, and every episode has a score or was given up.
    Complete,
    /// Training is complete, but no evaluator came that may have the run's environment.
    Unscored,
    OtherWeights(OtherWeights),
}

/// Retrained weights differ from the scored ones.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("the weights of step {step} are {trained}, but {scored} were scored before")]
pub struct OtherWeights {
    pub step: u64,
    /// Hash of the retrained weights.
    pub trained: Hash,
    /// Hash of the weights that have scores.
    pub scored: String,
}

/// The frame of an online episode, whole.
#[derive(Debug)]
pub struct Frame<Q> {
    /// The query that brought the last piece.
    pub query: Q,
    pub seed: u64,
    /// Number of the episode.
    pub number: u64,
    /// Hash of the bytes, as claimed.
    pub hash: Hash,
    pub bytes: Arc<Vec<u8>>,
}

impl<Q> Frame<Q> {
    /// Verifies the claimed hash, and decodes the episode.
    pub fn decode(&self) -> Result<Box<Episode>, CodecError> {
        let actual = Hash::new(&self.bytes);
        if actual != self.hash {
            return Err(CodecError::Hash { claimed: self.hash, actual });
        }
        decode(&self.bytes).map(Box::new)
    }
}

#[derive(Clone, Debug)]
pub enum Answer {
    Job(JobReply),
    Scores(ScoreReply),
    Piece(PieceReply),
    /// It is not acknowledged yet, for this reason: the evaluator is to try it again.
    TryAgain(String),
}

impl<Q> Order<Q> {
    pub(super) fn rejected(refusal: Refusal) -> Self {
        Self::Count(Count::Rejected(refusal.label()))
    }
}

/// A reason not to accept a message about a job or its results.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub(super) enum Refusal {
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
